"""Planning's inner functions as CUDA graphs: a GPU replays hundreds of small operations in one launch."""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

from planning import records
from planning.backends.capture import Graph, first_line
from planning.backends.eager import Item, Result, eager
from planning.backends.signature import flatten

# Graphs, each with its own results in the GPU's memory; those that were not used for the longest time go first.
MOST = 64
DEVICE = "cuda"


class CudaGraphs:
    """Each function is captured when it is first called with its constants and shapes, and replayed from then on.

    A graph calls the operations that the function called, with the same numbers, so results are those of eager
    execution; but shapes must not depend on values, so a model computes what it would otherwise leave out
    (`planning.protocol.FixedShapes`). Graphs read the weights where they are: they may change, but not move.

    A function that cannot be captured, because it waits for the GPU (a reward that calls `item()`, say), runs eagerly,
    which is said in one line, once for each function.

    Whole numbers are copied to the GPU. All graphs share one pool of memory, which is safe because they run one after
    the other, and results are copied out of it. Not for several threads at once.
    """

    native = False

    def __init__(self, tracing: Callable[[], AbstractContextManager[None]] = nullcontext) -> None:
        """`tracing`: opened while functions are captured, to tell models that shapes must not depend on values."""
        self._graphs: OrderedDict[Any, Graph[Any] | None] = OrderedDict()  # None runs eagerly
        self._tracing = tracing
        self._pool: Any = None
        self._refused: set[str] = set()  # names of functions, which were said

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """See `Backend`. Raises ValueError for tensors that are all on the CPU."""
        tensors: list[Tensor] = []
        signature: list[Any] = [function, torch.get_float32_matmul_precision(), torch.is_inference_mode_enabled()]
        flatten(arguments, tensors, signature)
        version = tuple(signature)
        if version not in self._graphs:
            self._graphs[version] = self._captured(function, arguments, tensors)
            if len(self._graphs) > MOST:
                self._graphs.popitem(last=False)
        self._graphs.move_to_end(version)
        graph = self._graphs[version]
        return function(*arguments) if graph is None else _copied(graph(tensors))

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """See `Backend`."""
        return eager.each(function, items)

    def _captured(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], tensors: list[Tensor]
    ) -> Graph[Any] | None:
        device = next((tensor.device for tensor in tensors if tensor.device.type == DEVICE), None)
        if device is None:
            raise ValueError(
                f"compile=cuda_graphs needs a model and a state on a GPU, and {function.__name__} got tensors on the "
                "CPU: choose compile=true, or plan on a GPU"
            )
        if self._pool is None:
            self._pool = torch.cuda.graph_pool_handle()
        try:
            with self._tracing():
                return Graph(function, arguments, tensors, device, self._pool)
        except RuntimeError as error:  # the base class of CUDA's errors
            if function.__name__ not in self._refused:
                self._refused.add(function.__name__)
                why = f"runs eagerly, since it cannot be captured as a CUDA graph: {first_line(error)}"
                print(f"{function.__name__} {why}", file=sys.stderr, flush=True)
            return None


def _copied(result: Any) -> Any:
    return records.apply(result, lambda value: value.clone() if isinstance(value, Tensor) else value)
