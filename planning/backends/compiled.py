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
    "freezing": True,  # weights become part of the code, packed as its products want them
    "cpp_wrapper": True,  # what calls the products is native as well, and lets go of the interpreter's lock
    "cpp.dynamic_threads": True,  # the same code for one thread and for several
    "cpp.use_decompose_tanh": True,  # faster than a call where numbers to be taken at once are few
    "unroll_reductions_threshold": 64,  # minima over the rectangles of a layout, and what is true of any object
    "compile_threads": 1,  # helper processes would compile no faster, and stay until the end
}


class Compiled:
    """Native code, which torch's Inductor writes when a function first meets its constants and shapes.

    That takes 5 to 20 seconds for each of a planner's four or five functions; torch keeps what can be used again in a
    cache on disk. Weights become part of the code: they must not change afterwards.

    Products of factors rounded to bfloat16 (torch's float32 precision "medium") are computed on tensors of bfloat16, so
    their results are rounded as well; with "highest" everything is float32.
    """

    def __init__(self) -> None:
        """Raises ValueError where there is no C++ compiler."""
        compiler = os.environ.get("CXX", "g++")
        if shutil.which(compiler) is None:
            raise ValueError(
                f"compile=true needs a C++ compiler, and '{compiler}' was not found: install it, name another one in "
                "the environment variable CXX, or take compile=false"
            )
        self._versions: dict[Any, _Native] = {}
        self._compiling = Lock()

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """See `Backend`. Raises ValueError for a function that cannot be compiled, saying why."""
        rounded = torch.get_float32_matmul_precision() != "highest"
        tensors: list[Tensor] = []
        traits: list[Any] = [function, rounded]
        _take_apart(arguments, tensors, traits)
        version = tuple(traits)
        native = self._versions.get(version)
        if native is None:
            native = self._first(version, function, rounded, arguments, tensors)
        return native(tensors)

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """See `Backend`: a thread of torch's for each of the items, as many at once as torch has threads."""
        items, threads = list(items), torch.get_num_threads()
        if min(len(items), threads) < 2:
            return eager.each(function, items)
        try:
            with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
                return list(pool.map(function, items))
        finally:
            torch.set_num_threads(threads)  # it is all threads' number in part

    def _first(
        self, version: Any, function: Callable[..., Any], rounded: bool, arguments: Any, tensors: list[Tensor]
    ) -> _Native:
        with self._compiling:
            if version not in self._versions:  # another thread may have been faster
                try:
                    self._versions[version] = _Native(function, rounded, arguments, tensors)
                except RuntimeError as error:  # as all of torch's are that say so
                    what = str(error).splitlines()[0]
                    raise ValueError(f"compile=true: {function.__name__} cannot be compiled: {what}") from error
            return self._versions[version]


class _Native:
    """One function for one kind of arguments; their kind is not looked at again."""

    def __init__(
        self, function: Callable[..., Any], rounded: bool, arguments: tuple[Any, ...], tensors: list[Tensor]
    ) -> None:
        """`tensors` are those of the `arguments`, in order."""
        forms: list[Any] = []
        with _distributions_unchecked():
            exported = torch.export.export(
                _InARow(function, rounded, arguments, forms.append), tuple(tensors), strict=False
            )
        graph = exported.module(check_guards=False)
        graph.graph.set_codegen(torch.fx.graph.CodeGen())  # in a row it comes and goes: nothing is to be taken apart
        graph.recompile()
        passes.rewrite(graph)
        self._call = torch._inductor.compile(graph, [*tensors], options=COMPILING)
        self._form = records.apply(forms[-1], lambda value: torch.empty(0) if isinstance(value, Tensor) else value)

    def __call__(self, tensors: list[Tensor]) -> Any:
        return _put_together(self._form, iter(self._call(*tensors)))


class _InARow(nn.Module):
    """A function as torch exports one: of tensors in a row, to tensors in a row. `keep` is given what it returns."""

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
        arguments = _put_together(self._arguments, iter(tensors))
        with torch.autocast(tensors[0].device.type, torch.bfloat16, enabled=self._rounded):
            result = records.apply(self._function(*arguments), _in_float32)
        self._keep(result)
        results: list[Tensor] = []
        _take_apart(result, results, [])
        return tuple(results)


@contextmanager
def _distributions_unchecked() -> Iterator[None]:
    """Torch's checks of distributions look at numbers, and compiled code has no branches."""
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


def _take_apart(value: Any, tensors: list[Tensor], traits: list[Any]) -> None:
    """Adds its tensors to `tensors`, in order, and to `traits` what a version is for: all but the tensors' numbers.

    A whole number becomes a tensor, so that one version serves the segments of a plan, whatever their number.
    """
    if isinstance(value, tuple):
        traits.append(type(value))
        for part in value:
            _take_apart(part, tensors, traits)
        return
    if isinstance(value, int) and not isinstance(value, bool):
        value = torch.tensor(value)
    if isinstance(value, Tensor):
        tensors.append(value)
        value = value.dtype, value.shape, value.stride()
    traits.append(value)


def _put_together(value: Any, tensors: Iterator[Tensor]) -> Any:
    """The same with other tensors, in order; whole numbers come back as the tensors that they became."""
    if isinstance(value, tuple):
        parts = [_put_together(part, tensors) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    counted = isinstance(value, int) and not isinstance(value, bool)
    return next(tensors) if counted or isinstance(value, Tensor) else value


def _in_float32(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.dtype == torch.bfloat16 else value
