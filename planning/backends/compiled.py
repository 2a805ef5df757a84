"""Planning's inner functions as native code."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from planning import records
from planning.backends import passes
from planning.backends.eager import Item, Result, eager

COMPILING = {
    "freezing": True,  # weights become constants, packed for the matrix products
    "cpp_wrapper": True,  # native code also calls the matrix products, and releases the interpreter's lock
    "cpp.dynamic_threads": True,  # the same code for one thread and for several
    "cpp.use_decompose_tanh": True,  # faster than a library call for small tensors
    "unroll_reductions_threshold": 64,  # unrolls minima over a layout's rectangles and reductions over objects
    "compile_threads": 1,  # worker processes would compile no faster and would stay until the end
}


class Compiled:
    """Native code, which torch's Inductor writes when a function is first called with its constants and shapes.

    This takes 5 to 20 seconds for each of a planner's four or five functions; torch caches on disk what it can reuse.
    Weights become part of the code: they must not change afterwards.

    Matrix products of factors rounded to bfloat16 (torch's float32 precision "medium") are computed on tensors of
    bfloat16, so their results are rounded as well; with "highest" everything is float32.
    """

    def __init__(self) -> None:
        """Raises ValueError where there is no C++ compiler."""
        compiler = os.environ.get("CXX", "g++")
        if shutil.which(compiler) is None:
            raise ValueError(
                f"compile=true needs a C++ compiler, and '{compiler}' was not found: install it, name another one in "
                "the environment variable CXX, or choose compile=false"
            )
        self._versions: dict[Any, _Native] = {}
        self._compiling = Lock()

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """See `Backend`. Raises ValueError for a function that cannot be compiled, saying why."""
        rounded = torch.get_float32_matmul_precision() != "highest"
        tensors: list[Tensor] = []
        signature: list[Any] = [function, rounded]
        _flatten(arguments, tensors, signature)
        version = tuple(signature)
        native = self._versions.get(version)
        if native is None:
            native = self._first(version, function, rounded, arguments, tensors)
        return native(tensors)

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """See `Backend`: one thread per item, as many at once as torch has threads."""
        items, threads = list(items), torch.get_num_threads()
        if min(len(items), threads) < 2:
            return eager.each(function, items)
        try:
            with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
                return list(pool.map(function, items))
        finally:
            torch.set_num_threads(threads)  # setting it in a worker thread also changes it here

    def _first(
        self, version: Any, function: Callable[..., Any], rounded: bool, arguments: Any, tensors: list[Tensor]
    ) -> _Native:
        with self._compiling:
            if version not in self._versions:  # another thread may have compiled it
                try:
                    self._versions[version] = _Native(function, rounded, arguments, tensors)
                except RuntimeError as error:  # the base class of torch's errors of compilation
                    what = str(error).splitlines()[0]
                    raise ValueError(f"compile=true: {function.__name__} cannot be compiled: {what}") from error
            return self._versions[version]


class _Native:
    """One compiled function for one signature of its arguments, which is not checked again."""

    def __init__(
        self, function: Callable[..., Any], rounded: bool, arguments: tuple[Any, ...], tensors: list[Tensor]
    ) -> None:
        """`tensors` are those of the `arguments`, in order."""
        results: list[Any] = []
        with _distributions_unchecked():
            exported = torch.export.export(
                _FlatFunction(function, rounded, arguments, results.append), tuple(tensors), strict=False
            )
        graph = exported.module(check_guards=False)
        graph.graph.set_codegen(torch.fx.graph.CodeGen())  # inputs and outputs are flat tuples: no pytree handling
        graph.recompile()
        passes.rewrite(graph)
        self._call = torch._inductor.compile(graph, [*tensors], options=COMPILING)
        self._form = records.apply(results[-1], lambda value: torch.empty(0) if isinstance(value, Tensor) else value)

    def __call__(self, tensors: list[Tensor]) -> Any:
        return _unflatten(self._form, iter(self._call(*tensors)))


class _FlatFunction(nn.Module):
    """A function of tensors that returns a flat tuple of tensors, as torch exports one. `keep` receives its result."""

    def __init__(
        self,
        function: Callable[..., Any],
        rounded: bool,
        arguments: tuple[Any, ...],
        keep: Callable[[Any], None],
    ) -> None:
        super().__init__()
        self._function = function
        self._rounded = rounded
        self._arguments = arguments
        self._keep = keep

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        arguments = _unflatten(self._arguments, iter(tensors))
        with torch.autocast(tensors[0].device.type, torch.bfloat16, enabled=self._rounded):
            result = records.apply(self._function(*arguments), _in_float32)
        self._keep(result)
        results: list[Tensor] = []
        _flatten(result, results, [])
        return tuple(results)


@contextmanager
def _distributions_unchecked() -> Iterator[None]:
    """Disable torch's validation of distributions: it branches on values, which compiled code cannot."""
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


def _flatten(value: Any, tensors: list[Tensor], signature: list[Any]) -> None:
    """Append the tensors of a value to `tensors`, in order, and all but their contents to `signature`.

    A whole number becomes a tensor, so one version serves every segment of a plan.
    """
    if isinstance(value, tuple):
        signature.append(type(value))
        for part in value:
            _flatten(part, tensors, signature)
        return
    if isinstance(value, int) and not isinstance(value, bool):
        value = torch.tensor(value)
    if isinstance(value, Tensor):
        tensors.append(value)
        value = value.dtype, value.shape, value.stride()
    signature.append(value)


def _unflatten(value: Any, tensors: Iterator[Tensor]) -> Any:
    """The inverse of `_flatten`, with other tensors; whole numbers return as the tensors that they became."""
    if isinstance(value, tuple):
        parts = [_unflatten(part, tensors) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    counted = isinstance(value, int) and not isinstance(value, bool)
    return next(tensors) if counted or isinstance(value, Tensor) else value


def _in_float32(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.dtype == torch.bfloat16 else value
