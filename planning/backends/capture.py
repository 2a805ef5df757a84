"""Functions captured as CUDA graphs, for plans and for steps of training."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor
from torch.distributions import Distribution

from planning.backends.signature import unflatten

Result = TypeVar("Result")


class Graph(Generic[Result]):
    """A function of tensors as a CUDA graph, for one signature of its arguments, which is not checked again."""

    def __init__(
        self,
        function: Callable[..., Result],
        arguments: Sequence[Any],
        tensors: Sequence[Tensor],
        device: torch.device,
        pool: Any,
    ) -> None:
        """`arguments`: of the function; `tensors`: theirs, by `signature.flatten`. For the rest see `capture`."""
        with torch.inference_mode(False):  # tensors that may be written in any mode
            self._inputs = [torch.empty_like(tensor, device=device) for tensor in tensors]
        self._write(tensors)
        given = unflatten(tuple(arguments), iter(self._inputs))
        self._graph, self._result = capture(lambda: function(*given), device, pool)

    def __call__(self, tensors: Sequence[Tensor]) -> Result:
        """The result for other tensors, whose place the next call writes over."""
        self._write(tensors)
        self._graph.replay()
        return self._result

    def _write(self, tensors: Sequence[Tensor]) -> None:
        for own, tensor in zip(self._inputs, tensors, strict=True):
            own.copy_(tensor, non_blocking=True)


def capture(function: Callable[[], Result], device: torch.device, pool: Any) -> tuple[torch.cuda.CUDAGraph, Result]:
    """A graph of all that `function` does on the device, and its result, which every replay writes anew.

    The function is called twice: once so that libraries allocate what they need, which no graph may do. Random numbers
    that it draws from the device's generator are drawn anew in every replay, and not used up here. Distributions do not
    check their arguments, for which they would wait.

    Args:
        pool: memory that graphs share, of `torch.cuda.graph_pool_handle`.

    Raises RuntimeError, as torch does, for a function that waits for the device or copies something to it. The first
    call finds most of these; a capture that fails can leave the device's generator unusable.
    """
    here, stream = torch.cuda.current_stream(device), _stream(device)
    with unchecked_distributions():
        stream.wait_stream(here)
        try:
            with torch.cuda.stream(stream), torch.random.fork_rng([device]), _no_waiting():
                function()
        finally:
            here.wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        # Inside of `here`, which is then current again also if the capture fails.
        with torch.cuda.stream(here), torch.cuda.graph(graph, pool=pool, stream=stream):
            result = function()
    return graph, result


def first_line(error: BaseException) -> str:
    """The first line of an error's message, of which torch's have many."""
    return (str(error).splitlines() or [repr(error)])[0]


@contextmanager
def unchecked_distributions() -> Iterator[None]:
    """Disable torch's validation of distributions: it branches on values, which neither graphs nor native code can."""
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


@cache
def _stream(device: torch.device) -> torch.cuda.Stream:
    """One stream for all captures: graphs of other streams would share no memory."""
    return torch.cuda.Stream(device)


@contextmanager
def _no_waiting() -> Iterator[None]:
    """Operations for which the host waits raise RuntimeError."""
    before = torch.cuda.get_sync_debug_mode()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of torch, that this mode is a prototype
            torch.cuda.set_sync_debug_mode("error")
        yield
    finally:
        torch.cuda.set_sync_debug_mode(before)
