"""What is given to parts: one clear line for numbers and names that cannot be."""

from __future__ import annotations

import functools
import inspect
import math
import re
import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from numbers import Integral, Real
from types import UnionType
from typing import Any, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

P = ParamSpec("P")
T = TypeVar("T")
MAY_BE_ZERO = ("neighbours", "depth")  # of the whole numbers that parts are built with
VARIADIC = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


def check_number(
    name: str, value: Any, low: float = 0, high: float = math.inf, *, whole: bool = False, positive: bool = False
) -> None:
    """Raise ValueError unless a value is a finite number in a range; strings, NaN and truth values are none.

    `whole`: without a fraction. `positive`: not 0 either.
    """
    number = isinstance(value, Integral if whole else Real) and not isinstance(value, bool)
    if not (number and low <= value <= high and abs(value) < math.inf) or (positive and value == 0):
        least = "above 0" if positive else f"of at least {low:.10g}"
        span = f"{least} and at most {high:.10g}" if high < math.inf else least
        raise ValueError(f"{name} must be a {'whole ' if whole else ''}number {span}, not {told(value)}")


def check_choice(name: str, value: Any, choices: Iterable[Any]) -> None:
    """Raise ValueError unless a value is one of the choices, which it names."""
    if value not in [*choices]:
        raise ValueError(f"unknown {name} {value!r}: choose from {', '.join(map(str, choices))}")


def check_kinds(given: Mapping[str, Any], hints: Mapping[str, Any], error: type[Exception] = ValueError) -> None:
    """Raise an `error` unless each value is of the type, `Sequence[int] | None` or the like, of `hints`."""
    for name in hints:
        if name in given and not _fits(given[name], hints[name]):
            wanted = hints[name].__name__ if isinstance(hints[name], type) else str(hints[name])
            wanted = re.sub(r"\b(\w+\.)+", "", wanted)
            raise error(f"{name} must be of type {wanted}, not {told(given[name])}")


def check_last(name: str, value: Any, size: int) -> None:
    """Raise ValueError unless a value is a tensor `[..., size]`."""
    if (shape := getattr(value, "shape", ()))[-1:] != (size,):
        raise ValueError(f"{name} must be a tensor [..., {size}], not {[*shape] or told(value)}")


def told(value: Any) -> str:
    """A value in an error's line: what has no short text is told by its class."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    said = repr(value)
    return f"an object of {type(value).__name__}" if "\n" in said or said[:1] == "<" else reprlib.repr(value)


def check_arguments(kind: type, by_position: Sequence[Any], by_keyword: Mapping[str, Any]) -> None:
    """Raise ValueError unless arguments of a class are of their annotations' types, and whole numbers are above 0."""
    taken = parameters_of(kind)
    given = {**dict(zip(taken, by_position, strict=False)), **by_keyword}
    hints = {name: one.annotation for name, one in taken.items()}
    for name, value in given.items():
        if hints.get(name) in (int, int | None) and value is not None:
            check_number(name, value, int(name not in MAY_BE_ZERO), whole=True)
    check_kinds(given, hints)


def parameters_of(made: Any, package: str = "") -> dict[str, inspect.Parameter]:
    """The named arguments of a function, or of a class with those that it passes on to its parents', with types.

    `package`: the only one whose constructors are read.
    """
    constructors = [made]
    if inspect.isclass(made):
        constructors = [vars(one)["__init__"] for one in made.__mro__ if "__init__" in vars(one)]
    found: dict[str, inspect.Parameter] = {}
    for constructor in constructors:
        if not inspect.isfunction(constructor) or not constructor.__module__.startswith(package):
            break
        hints, parameters = dict[str, Any](), inspect.signature(constructor).parameters.values()
        with suppress(NameError):  # of a user's class, imported for type checkers alone
            hints = get_type_hints(constructor)
        for one in parameters:
            if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY) and one.name != "self":
                found.setdefault(one.name, one.replace(annotation=hints.get(one.name, Any)))
        if not any(one.kind is one.VAR_KEYWORD for one in parameters):
            break
    return found


def typed(error: type[Exception]) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorate a function: an argument that is not of the type of its annotation is an `error` of one line."""

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        signature, hints = inspect.signature(function), functools.cache(functools.partial(get_type_hints, function))
        names = [name for name, one in signature.parameters.items() if one.kind not in VARIADIC]

        @functools.wraps(function)
        def called(*arguments: P.args, **keywords: P.kwargs) -> T:
            given = signature.bind(*arguments, **keywords).arguments
            check_kinds({name: given[name] for name in names if name in given}, hints(), error)
            return function(*arguments, **keywords)

        return called

    return decorate


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of an annotation's type, as are the entries of a sequence."""
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return any(_fits(value, one) for one in inner)
    if kind in (list, tuple, Sequence) and inner:
        value = value.tolist() if hasattr(value, "tolist") else value  # an array or a tensor
        listed = isinstance(value, Sequence) and not isinstance(value, str | bytes)
        return listed and all(_fits(one, inner[0]) for one in value)
    if kind in (int, float):
        return isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
    with suppress(TypeError):  # of a protocol that is for type checkers alone
        return not isinstance(kind, type) or kind is Any or isinstance(value, kind)
    return True
