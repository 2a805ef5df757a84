"""Planning's inner functions as native code."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from types import FunctionType
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from planning import fields
from planning.engine import Item, Result, directly

COMPILING = {
    "freezing": True,  # weights become part of the code, packed as its products want them
    "cpp_wrapper": True,  # what calls the products is native as well, and lets go of the interpreter's lock
    "cpp.dynamic_threads": True,  # the same code for one thread and for several
    "cpp.use_decompose_tanh": True,  # faster than a call where numbers to be taken at once are few
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
        self._versions: dict[Any, Callable[..., Any]] = {}
        self._compiling = Lock()

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """See `Engine`. Raises ValueError for a function that cannot be compiled, saying why."""
        arguments = tuple(map(_without_count, arguments))
        rounded = torch.get_float32_matmul_precision() != "highest"
        version = (function, rounded, *_traits(arguments, []))
        native = self._versions.get(version)
        return self._first(function, rounded, version, arguments) if native is None else native(*arguments)

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """See `Engine`: a thread of torch's for each of the items, as many at once as torch has threads."""
        items, threads = list(items), torch.get_num_threads()
        if min(len(items), threads) < 2:
            return directly.each(function, items)
        try:
            with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
                return list(pool.map(function, items))
        finally:
            torch.set_num_threads(threads)  # it is all threads' number in part

    def _first(self, function: Callable[..., Any], rounded: bool, version: Any, arguments: tuple[Any, ...]) -> Any:
        with self._compiling:
            if version not in self._versions:  # another thread may have been faster
                native = _compiled(function, rounded, len(self._versions))
                try:
                    with torch._inductor.config.patch(COMPILING), _distributions_unchecked():
                        native(*arguments)
                except (torch._dynamo.exc.TorchDynamoException, torch._inductor.exc.InductorError) as error:
                    what = str(error).splitlines()[0]
                    raise ValueError(f"compile=true: {function.__name__} cannot be compiled: {what}") from error
                self._versions[version] = native
        return self._versions[version](*arguments)


@contextmanager
def _distributions_unchecked() -> Iterator[None]:
    """Torch's checks of distributions look at numbers, and compiled code has no branches."""
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


def _compiled(function: Callable[..., Any], rounded: bool, number: int) -> Callable[..., Any]:
    def native(*arguments: Any) -> Any:
        with torch.autocast(_device(arguments), torch.bfloat16, enabled=rounded):
            return fields.apply(function(*arguments), _in_float32)

    # Torch keeps what it has compiled with the code object. Each version has one of its own, since only tensors are
    # compared at a call: comparing all that a model consists of takes longer than some of the functions.
    own = FunctionType(
        native.__code__.replace(co_name=f"{function.__name__}_{number}"), globals(), closure=native.__closure__
    )
    options: dict[str, Any] = {"guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe}
    return torch.compile(own, fullgraph=True, dynamic=False, options=options)


def _without_count(value: Any) -> Any:
    """A whole number as a tensor, so that one version serves the segments of a plan, whatever their number."""
    return torch.tensor(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _in_float32(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.dtype == torch.bfloat16 else value


def _traits(value: Any, traits: list[Any]) -> list[Any]:
    """Adds to `traits` what a version is for: constants, and the shapes of tensors, in order."""
    if isinstance(value, tuple):
        traits.append(type(value))
        for field in value:
            _traits(field, traits)
    else:
        traits.append(value.shape if isinstance(value, Tensor) else value)
    return traits


def _device(value: Any) -> str:
    """Type of the first tensor's device; empty where there is no tensor."""
    if isinstance(value, tuple):
        return next(filter(None, map(_device, value)), "")
    return value.device.type if isinstance(value, Tensor) else ""
