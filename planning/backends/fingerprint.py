"""Digests of functions and their constants that are equal in every process, as keys of what is kept on disk."""

from __future__ import annotations

import ast
import enum
import hashlib
import struct
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache, cached_property, partial
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType, NoneType, SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

INSTALLED = ("site-packages", "dist-packages")
MACHINERY = {*vars(nn.Module())} - {"_parameters", "_buffers", "_modules", "training"}  # hooks are looked at
# Pyro's bookkeeping of a traced program, which changes with every run of it and decides no result of a network.
BOOKKEEPING = {"_pyro_context", "_pyro_name"}


class UnknownValueError(TypeError):
    """A value whose state cannot be read, so it has no fingerprint."""


def fingerprint(values: Iterable[Any], modules: Iterable[str] = ()) -> str:
    """A digest (hexadecimal) of values: numbers, strings, tensors, networks, functions, records and other objects.

    Objects count with their class and attributes, tensors with their numbers. The source of every function and class,
    and of all modules that theirs import, counts as well, and that of the named `modules`.

    Raises UnknownValueError for an object that keeps its state where Python cannot see it.
    """
    walk = _Walk()
    for value in values:
        walk.add(value)
    walk.digest.update(_sources({*walk.modules, *modules}))
    return walk.digest.hexdigest()


class _Walk:
    """Feeds values to a digest, depth first."""

    def __init__(self) -> None:
        self.digest = hashlib.sha256()
        self.modules: set[str] = set()  # of the functions and classes that were met
        self._seen: dict[int, int] = {}
        self._kept: list[Any] = []  # so that no other object takes the place of one that was seen

    def add(self, value: Any) -> None:
        """Add one value, with what it refers to."""
        if value is None or type(value) in (bool, int, str, bytes):
            return self._write(type(value).__name__, repr(value))
        if isinstance(value, float):
            return self._write("float", struct.pack("<d", value).hex())
        if isinstance(value, torch.dtype | torch.device | torch.layout):
            return self._write("torch", str(value))
        if isinstance(value, type):
            return self._add_class(value)
        if id(value) in self._seen:
            return self._write("again", str(self._seen[id(value)]))
        self._seen[id(value)] = len(self._seen)
        self._kept.append(value)
        if isinstance(value, Tensor):
            return self._add_tensor(value)
        if isinstance(value, FunctionType | MethodType | BuiltinFunctionType | partial):
            return self._add_function(value)
        if isinstance(value, enum.Enum):
            return self._add_parts("enum", (type(value), value.name))
        return self._add_object(value)

    def _write(self, kind: str, text: str) -> None:
        self.digest.update(f"{kind}:{len(text)}:{text};".encode())

    def _add_parts(self, kind: str, parts: Iterable[Any]) -> None:
        parts = list(parts)
        self._write(kind, str(len(parts)))
        for part in parts:
            self.add(part)

    def _add_class(self, found: type) -> None:
        self.modules.update(one.__module__ for one in found.__mro__)
        self._write("class", f"{found.__module__}.{found.__qualname__}")

    def _add_tensor(self, tensor: Tensor) -> None:
        self._add_parts("tensor", (type(tensor), tensor.dtype, tensor.device, *tensor.shape))
        if tensor.layout != torch.strided:
            raise UnknownValueError(f"a tensor of layout {tensor.layout}")
        numbers = tensor.detach().cpu().contiguous().flatten().view(torch.uint8) if tensor.numel() else tensor
        self.digest.update(numbers.numpy().tobytes() if tensor.numel() else b"")

    def _add_function(self, function: Any) -> None:
        if isinstance(function, MethodType):
            return self._add_parts("method", (function.__func__, function.__self__))
        if isinstance(function, partial):
            return self._add_parts("partial", (function.func, function.args, function.keywords))
        self._write("function", f"{function.__module__}.{function.__qualname__}")
        self.modules.add(function.__module__)
        if not isinstance(getattr(function, "__self__", None), ModuleType | NoneType):
            self.add(function.__self__)  # of a built-in method
        if isinstance(function, FunctionType):
            self._write("code", _code(function.__code__))
            cells = [cell.cell_contents for cell in function.__closure__ or ()]
            self._add_parts("closure", (function.__defaults__, function.__kwdefaults__, *cells))
        return None

    def _add_object(self, value: Any) -> None:
        self._add_class(type(value))
        content: list[Any] = []
        if isinstance(value, tuple | list):
            content += value
        elif isinstance(value, Mapping):
            content += [part for pair in value.items() for part in pair]
        elif isinstance(value, set | frozenset):
            content += sorted(value, key=repr)
        elif isinstance(value, int | str | bytes):  # of a subclass
            content.append(repr(value))
        elif not _is_readable(value):
            raise UnknownValueError(f"{type(value).__module__}.{type(value).__qualname__}")
        self._add_parts("content", content)
        attributes = {**getattr(value, "__dict__", {}), **_slots(value)}
        for name in sorted(attributes):
            computed = isinstance(getattr(type(value), name, None), cached_property)
            machinery = isinstance(value, nn.Module) and name in MACHINERY and not attributes[name]
            if not computed and not machinery and name not in BOOKKEEPING:
                self._write("attribute", name)
                self.add(attributes[name])


def _is_readable(value: Any) -> bool:
    """Whether all of an object's state is in attributes and slots, as for classes written in Python."""
    if type(value) in (object, SimpleNamespace):
        return type(value) is SimpleNamespace  # a bare object is its identity
    if type(value).__reduce__ is not object.__reduce__ or type(value).__reduce_ex__ is not object.__reduce_ex__:
        return False
    try:
        object.__reduce_ex__(value, 2)  # refuses objects that are larger than these
    except TypeError:
        return False
    return True


def _slots(value: Any) -> dict[str, Any]:
    found = {}
    for one in type(value).__mro__:
        slots = vars(one).get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            private = name.startswith("__") and not name.endswith("__")
            name = f"_{one.__name__.lstrip('_')}{name}" if private else name
            if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                found[name] = getattr(value, name)
    return found


def _code(code: CodeType) -> str:
    """What tells apart two functions of one name in one file, without places on this machine."""
    constants = [_code(one) if isinstance(one, CodeType) else repr(one) for one in code.co_consts]
    return repr((code.co_code, code.co_names, constants if code.co_name == "<lambda>" else code.co_firstlineno))


def _sources(modules: Iterable[str]) -> bytes:
    """Digest of the modules' sources and of all that they import, by file; of installed packages by version."""
    found: dict[str, str] = {}
    waiting = [*modules]
    while waiting:
        name = waiting.pop()
        if name in found or name not in sys.modules:
            continue
        found[name], imports = _source(name)
        waiting += imports
    return hashlib.sha256(repr(sorted(found.items())).encode()).digest()


@cache
def _source(name: str) -> tuple[str, tuple[str, ...]]:
    """What stands for a module's source, and the names of what it imports."""
    module, top = sys.modules[name], name.partition(".")[0]
    if top in sys.stdlib_module_names or top == "torch":
        return "", ()  # their versions are in the key
    file = getattr(module, "__file__", None)
    version = getattr(sys.modules.get(top), "__version__", None)
    if version is not None and file is not None and any(part in INSTALLED for part in Path(file).parts):
        return f"version {version}", ()
    if file is None or not Path(file).is_file():
        raise UnknownValueError(f"the module {name}, which has no source")
    source = Path(file).read_bytes()
    imports = _imports(source, module.__package__ or "") if Path(file).suffix == ".py" else ()
    return hashlib.sha256(source).hexdigest(), tuple(imports)


def _imports(source: bytes, package: str) -> Iterator[str]:
    """Names of all modules that a source may import, and of what is in them."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)
