"""Backends: how planning's inner functions run, and how several environments follow one another.

An inner function is a pure function of tensors, of named tuples of such, and of constants (a model, a reward, a number
that options set), which are told apart by `==`. Random numbers are sampled before and passed in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Backend(Protocol):
    """Runs functions: `eager`, or `planning.backends.compiled.Compiled`."""

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """`function(*arguments)`."""

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """`function(item)` of each, in order; `function` calls the backend in its turn."""


class Eager:
    """One operation of torch at a time, with all of torch's threads."""

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """See `Backend`."""
        return function(*arguments)

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """See `Backend`."""
        return [function(item) for item in items]


eager = Eager()
