"""Functions captured as CUDA graphs, for plans and for steps of training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import torch

Result = TypeVar("Result")


def capture(function: Callable[[], Result], device: torch.device, pool: Any) -> tuple[torch.cuda.CUDAGraph, Result]:
    """A graph of all that `function` does on the device, and its result, which every replay writes anew.

    The function is called twice: once so that libraries allocate what they need, which no graph may do. Random numbers
    that it draws from the device's generator are drawn anew in every replay, and not used up here. `pool`: of memory.

    Raises RuntimeError, as torch does, for a function that waits for the device or copies something to it. The first
    call finds that out: a capture that fails leaves the device's generator unusable.
    """
    here, stream = torch.cuda.current_stream(device), torch.cuda.Stream(device)
    stream.wait_stream(here)
    with torch.cuda.stream(stream), torch.random.fork_rng([device]), _no_waiting():
        function()
    here.wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, pool=pool, stream=stream):
        result = function()
    return graph, result


@contextmanager
def _no_waiting() -> Iterator[None]:
    """Operations for which the host waits raise RuntimeError."""
    before = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode(before)
