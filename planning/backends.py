"""How planning's inner functions run: eager, compiled by `torch.compile`, or as CUDA graphs.

An inner function is a pure function of tensors, named tuples of tensors, and constants (a model, a reward, a number
from the options). Callers sample random numbers and pass them in. Models, priors, rewards and planners do not depend on
how they run.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from cavin_pyro.planning import records
from cavin_pyro.planning.checks import UnsuitedError

GRAPHS = "cuda_graphs"  # value of `compile`
MOST_GRAPHS = 64  # each keeps its results in the GPU's memory
Backend = Callable[..., Any]  # eager, Compiled or CudaGraphs: a function and its arguments -> what it returns


def eager(function: Callable[..., Any], *arguments: Any) -> Any:
    """Eager execution, one operation of torch at a time."""
    return function(*arguments)


def make_backend(
    compile: bool | str, fixed_shapes: Callable[[], AbstractContextManager[None]] = nullcontext
) -> Backend:
    """The backend that the option `compile` names; for `fixed_shapes` see `CudaGraphs`.

    Raises ValueError for another value than true, false and `cuda_graphs`.
    """
    if compile == GRAPHS:
        return CudaGraphs(fixed_shapes)
    if not isinstance(compile, bool):
        raise ValueError(f"compile must be true, false or {GRAPHS}, not {compile}")
    return Compiled() if compile else eager


class Compiled:
    """Functions compiled by `torch.compile`, for every kind of arguments when it is first met.

    This takes minutes for the four or five functions of a planner; torch keeps the code on disk, where later processes
    find it (`TORCHINDUCTOR_CACHE_DIR`). Results are those of eager execution up to rounding. Distributions no longer
    check their arguments in this process, because the checks branch on values.
    """

    def __init__(self) -> None:
        Distribution.set_default_validate_args(False)
        self._functions: dict[Callable[..., Any], Callable[..., Any]] = {}

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """See `Backend`. What torch cannot compile, such as a reward that calls `item()`, runs eagerly."""
        if function not in self._functions:
            # Sizes are constants, for which torch writes faster code. Each number of objects is another version.
            self._functions[function] = torch.compile(function, dynamic=False)
        return self._functions[function](*map(_as_tensor, arguments))


class CudaGraphs:
    """Each function is captured when it is first called with its constants and shapes, and replayed from then on.

    A GPU replays hundreds of small operations in one launch. A graph calls the operations that the function called, so
    results are those of eager execution; but shapes must not depend on values, so a model computes what it would
    otherwise leave out (`FixedShapes`). Graphs read the weights where they are: these may change, but
    not move.

    A function that cannot be captured, because it waits for the GPU (a reward that calls `item()`, say), runs eagerly,
    which is said in one line. All graphs share one pool of memory, which is safe because they run one after the other,
    and results are copied out of it. Not for several threads at once.
    """

    def __init__(self, fixed_shapes: Callable[[], AbstractContextManager[None]] = nullcontext) -> None:
        """`fixed_shapes`: opened while functions are captured, to tell models that shapes must not depend on values."""
        Distribution.set_default_validate_args(False)  # its checks branch on values, which no graph can
        self._graphs: dict[Any, Graph | None] = {}  # None runs eagerly; the one that was used last comes last
        self._fixed_shapes = fixed_shapes
        self._stream: Any = None  # one for all captures: graphs of other streams would share no memory
        self._pool: Any = None

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """See `Backend`. Raises ValueError for tensors that are all on the CPU."""
        arguments = tuple(map(_as_tensor, arguments))
        tensors: list[Tensor] = []
        kind = (
            function,
            torch.get_float32_matmul_precision(),
            torch.is_inference_mode_enabled(),
            _kind(arguments, tensors),
        )
        if kind not in self._graphs:
            if len(self._graphs) == MOST_GRAPHS:
                del self._graphs[next(iter(self._graphs))]
            self._graphs[kind] = self._captured(function, arguments, tensors)
        self._graphs[kind] = graph = self._graphs.pop(kind)
        return function(*arguments) if graph is None else graph(tensors)

    def _captured(self, function: Callable[..., Any], arguments: Any, tensors: list[Tensor]) -> Graph | None:
        device = next((tensor.device for tensor in tensors if tensor.device.type == "cuda"), None)
        if device is None:
            raise UnsuitedError(
                f"compile={GRAPHS} needs a model and a state on a GPU, and {function.__name__} got tensors on the CPU: "
                "choose compile=true, or plan on a GPU"
            )
        if self._stream is None:
            self._stream, self._pool = torch.cuda.Stream(device), torch.cuda.graph_pool_handle()
        try:
            with self._fixed_shapes():
                return Graph(function, arguments, device, self._stream, self._pool)
        except RuntimeError as error:  # the base class of CUDA's errors
            why = (str(error).splitlines() or [repr(error)])[0]
            print(
                f"{function.__name__} runs eagerly, since it cannot be captured as a CUDA graph: {why}", file=sys.stderr
            )
            return None


class Graph:
    """A function of tensors as a CUDA graph, for one kind of arguments, which is not checked again."""

    def __init__(
        self, function: Callable[..., Any], arguments: Any, device: torch.device, stream: torch.cuda.Stream, pool: Any
    ) -> None:
        """Calls the function twice: once so that libraries allocate what they need, which no graph may do, and so that
        operations for which the host waits raise RuntimeError before the capture.
        """
        with torch.inference_mode(False):  # tensors that may be written in any mode
            own = records.apply(arguments, lambda one: one.to(device, copy=True) if isinstance(one, Tensor) else one)
        self._inputs: list[Tensor] = []
        _kind(own, self._inputs)
        here = torch.cuda.current_stream(device)
        stream.wait_stream(here)
        try:
            with torch.cuda.stream(stream), torch.random.fork_rng([device]), _no_waiting():
                function(*own)
        finally:
            here.wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        # Inside of `here`, which is then current again also if the capture fails.
        with torch.cuda.stream(here), torch.cuda.graph(self._graph, pool=pool, stream=stream):
            self._result = function(*own)

    def __call__(self, tensors: Sequence[Tensor]) -> Any:
        return records.apply(self.replay(tensors), lambda one: one.clone() if isinstance(one, Tensor) else one)

    def replay(self, tensors: Sequence[Tensor]) -> Any:
        """The function's result in tensors that the next replay overwrites; `tensors`: those of its arguments."""
        for own, tensor in zip(self._inputs, tensors, strict=True):
            own.copy_(tensor, non_blocking=True)
        self._graph.replay()
        return self._result


def _as_tensor(argument: Any) -> Any:
    """The same, but a whole number as a tensor, so that one version serves every segment of a plan."""
    return torch.tensor(argument) if type(argument) is int else argument


def _kind(value: Any, tensors: list[Tensor]) -> Any:
    """All but the contents of a value's tensors, which are appended to `tensors`."""
    if isinstance(value, tuple):
        return type(value), *(_kind(part, tensors) for part in value)
    if isinstance(value, Tensor):
        tensors.append(value)
        return value.dtype, value.shape, value.stride()
    return value


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
