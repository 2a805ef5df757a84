"""Planning's inner functions as native code, which is compiled once and cached on disk."""

from __future__ import annotations

import os
import platform
import shutil
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import cache
from pathlib import Path
from threading import Lock
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from planning import records
from planning.backends import passes
from planning.backends.cache import VARIABLE, CodeCache, UnsafeFolderError, default_folder
from planning.backends.capture import unchecked_distributions
from planning.backends.eager import Item, Result, eager
from planning.backends.fingerprint import UnknownValueError, fingerprint
from planning.backends.library import PROXY_EXECUTOR, Library
from planning.backends.signature import flatten, unflatten

COMPILING = {
    "freezing": True,  # weights become constants, packed for the matrix products
    "cpp_wrapper": True,  # native code also calls the matrix products, and releases the interpreter's lock
    "cpp.dynamic_threads": True,  # the same code for one thread and for several
    "cpp.use_decompose_tanh": True,  # faster than a library call for small tensors
    "unroll_reductions_threshold": 64,  # unrolls minima over a layout's rectangles and reductions over objects
    "compile_threads": 1,  # worker processes would compile no faster and would stay until the end
}
# Of this machine, for which loops are divided, in code for any number of threads: a process with one of them finds the
# code of one with several.
THREADS = os.cpu_count() or 1
COUNTS = {"num_logical_cores", "num_physical_cores", "num_sockets"}


class Compiled:
    """Native code, which torch's AOTInductor writes when a function is first called with its constants and shapes.

    This takes one to three minutes for the four or five functions of a planner. The code is cached in a folder of the
    user's (`planning.backends.cache`), where later processes find it by a key of everything that determines it. Weights
    become part of the code: they must not change afterwards.

    Matrix products of factors rounded to bfloat16 (torch's float32 precision "medium" or "high") are computed on
    tensors of bfloat16, so their results are rounded as well; with "highest" everything is float32.

    Without such a folder, or for constants without a fingerprint, it compiles for this process only.

    With `make=False` it never compiles: it loads what the cache has, and runs all other functions eagerly.
    """

    def __init__(
        self,
        folder: Path | None = None,
        tracing: Callable[[], AbstractContextManager[None]] = nullcontext,
        *,
        make: bool = True,
    ) -> None:
        """`folder`: of the cache; None is `planning.backends.cache.default_folder`. `tracing`: opened while functions
        become graphs, to tell models that shapes must not depend on values (`planning.protocol.FixedShapes`).

        Raises ValueError where code is to be made and there is no C++ compiler.
        """
        compiler = os.environ.get("CXX", "g++")
        if make and shutil.which(compiler) is None:
            raise ValueError(
                f"compile=true needs a C++ compiler, and '{compiler}' was not found: install it, name another one in "
                "the environment variable CXX, or choose compile=false"
            )
        self._versions: dict[Any, _Native | None] = {}  # None runs eagerly
        self._compiling = Lock()
        self._tracing = tracing
        self._makes = make
        self._cache: CodeCache | None = None
        self._refused = False  # the folder, which was said
        try:
            folder = folder or default_folder()
            if make or folder.exists():
                self._cache = CodeCache(folder)
        except OSError as error:
            why = error if isinstance(error, UnsafeFolderError) else f"{error.filename}: {error.strerror}"
            what = "is made for this process only" if make else "is not loaded"
            self._refused = True
            _say(f"native code {what}: {why} ({VARIABLE}=DIR names another folder)")

    @property
    def native(self) -> bool:
        """See `Backend`."""
        return bool(self._versions) and None not in self._versions.values()

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """See `Backend`. Raises ValueError where code is to be made, for tensors elsewhere than on the CPU, and for a
        function that cannot be compiled, saying why.
        """
        rounded = torch.get_float32_matmul_precision() != "highest"
        tensors: list[Tensor] = []
        signature: list[Any] = [function, rounded]
        flatten(arguments, tensors, signature)
        version = tuple(signature)
        if version not in self._versions:
            self._first(version, _FlatFunction(function, rounded, arguments), tensors)
        native = self._versions[version]
        return function(*arguments) if native is None else native(tensors)

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

    def _first(self, version: Any, function: _FlatFunction, tensors: list[Tensor]) -> None:
        with self._compiling, unchecked_distributions(), self._tracing():
            if version not in self._versions:  # another thread may have made it
                try:
                    self._versions[version] = self._make(version, function, tensors)
                except RuntimeError as error:  # the base class of torch's errors of compilation
                    if not self._makes:
                        raise
                    what = str(error).splitlines()[0]
                    raise ValueError(f"compile=true: {function.name} cannot be compiled: {what}") from error

    def _make(self, version: Any, function: _FlatFunction, tensors: list[Tensor]) -> _Native | None:
        if elsewhere := [tensor.device.type for tensor in tensors if tensor.device.type != "cpu"]:
            if not self._makes:
                return None
            raise ValueError(
                f"compile=true makes native code for the CPU, and {function.name} got tensors on {elsewhere[0]}: "
                "choose compile=false, or plan on the CPU"
            )
        library = self._library(version, function, tensors)
        if library is None and not self._makes:
            if not self._refused:
                _say(
                    "planning eagerly, since no native code is cached for this configuration: planner.compile=true "
                    "compiles it, once, in one to three minutes; planner.compile=false looks for none"
                )
            return None
        if library is None:
            _announce("is made for this process only")
            code = torch._inductor.compile(_graph(function, tensors), [*tensors], options=COMPILING)
            return _Native(lambda given: code(*given), function.form())
        function(*tensors)  # once eagerly, which tells the form of its result
        return _Native(library, function.form())

    def _library(self, version: Any, function: _FlatFunction, tensors: list[Tensor]) -> Library | None:
        """Loaded from the cache, or compiled and stored there; None without a cache, if it cannot store it, or if it is
        to make none.
        """
        if self._cache is None:
            return None
        try:
            key = fingerprint([*_circumstances(), *version], [__name__])
        except UnknownValueError:
            return None
        if (library := self._cache.load(key)) is not None or not self._makes:
            return library
        try:
            with self._cache.building(key) as folder:
                if (library := self._cache.load(key)) is not None:  # another process has made it in the meantime
                    return library
                _announce(f"is cached in {self._cache.folder}")
                code = _shared_library(_graph(function, tensors), tensors, folder)
                if PROXY_EXECUTOR in code:
                    return None
                self._cache.store(key, code)
        except OSError as error:
            _say(f"native code cannot be cached: {error}")
        return self._cache.load(key)


class _Native:
    """Native code for one signature of its arguments, which is not checked again."""

    def __init__(self, code: Callable[[list[Tensor]], Sequence[Tensor]], form: Any) -> None:
        """`form`: the function's result, with anything in the place of tensors."""
        self._code = code
        self._form = form

    def __call__(self, tensors: list[Tensor]) -> Any:
        return unflatten(self._form, iter(self._code(tensors)))


def _announce(where: str) -> None:
    _say(f"compiling for the first plan, which takes one to three minutes; native code {where}")


@cache
def _say(line: str) -> None:
    """On standard error, once in a process."""
    print(line, file=sys.stderr, flush=True)


@cache
def _circumstances() -> tuple[str, ...]:
    """What else determines native code: versions, options, and this machine."""
    processor: Any = sorted((name, value) for name, value in torch.cpu.get_capabilities().items() if name not in COUNTS)
    with suppress(OSError):  # compilers are told to use all that this machine has, which Linux lists
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        processor.append(next((line for line in lines if line.lower().startswith(("flags", "features"))), ""))
    given = sorted(pair for pair in os.environ.items() if pair[0].startswith("TORCHINDUCTOR_") and "DIR" not in pair[0])
    where = platform.system(), platform.machine(), platform.libc_ver(), sys.version_info[:2]
    versions = torch.__version__, torch.version.git_version, torch.backends.mkldnn.is_available()
    return tuple(map(repr, (where, versions, COMPILING, THREADS, os.environ.get("CXX"), given, processor)))


def _graph(function: _FlatFunction, tensors: list[Tensor]) -> torch.fx.GraphModule:
    exported = torch.export.export(function, tuple(tensors), strict=False)
    graph = exported.module(check_guards=False)
    graph.graph.set_codegen(torch.fx.graph.CodeGen())  # inputs and outputs are flat tuples: no pytree handling
    graph.recompile()
    passes.rewrite(graph)
    _register_constants(graph)
    return graph


def _register_constants(graph: torch.fx.GraphModule) -> None:
    """Make buffers of constants in the code: Inductor's freezing loses other constants that are read twice.

    It deletes such a constant where one of its readers is folded away, and then misses it for the other.
    """
    for part in graph.modules():
        for name, value in list(vars(part).items()):
            if isinstance(value, Tensor):
                delattr(part, name)
                part.register_buffer(name, value)


def _shared_library(graph: torch.fx.GraphModule, tensors: list[Tensor], folder: Path) -> bytes:
    options = {**COMPILING, "cpp.threads": THREADS, "aot_inductor.output_path": str(folder / "code.so")}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch about torch
        path = torch._inductor.aot_compile(graph, tuple(tensors), options=options)
    return Path(str(path)).read_bytes()


class _FlatFunction(nn.Module):
    """A function of tensors that returns a flat tuple of tensors, as torch exports one.

    After a call, `form()` is its result, with empty tensors.
    """

    def __init__(self, function: Callable[..., Any], rounded: bool, arguments: tuple[Any, ...]) -> None:
        """`arguments`: with any tensors of the right shapes."""
        super().__init__()
        self.name = function.__name__
        self._last = SimpleNamespace(result=None)  # a bare attribute would be taken for a part of the graph
        self._function = function
        self._rounded = rounded
        self._arguments = arguments

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        arguments = unflatten(self._arguments, iter(tensors))
        with torch.autocast(tensors[0].device.type, torch.bfloat16, enabled=self._rounded):
            result = records.apply(self._function(*arguments), _in_float32)
        self._last.result = result
        results: list[Tensor] = []
        flatten(result, results, [])
        return tuple(results)

    def form(self) -> Any:
        """The last result, without its numbers."""
        return records.apply(self._last.result, lambda value: torch.empty(0) if isinstance(value, Tensor) else value)


def _in_float32(value: Any) -> Any:
    return value.float() if isinstance(value, Tensor) and value.dtype == torch.bfloat16 else value
