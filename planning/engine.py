"""How planning's inner functions are called, and how several environments follow one another.

An inner function is a pure function of tensors, of named tuples of such, and of constants (a model, a reward, a number
that options set), which are told apart by `==`. What is random in it is drawn before and handed over.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Engine(Protocol):
    """Calls functions."""

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """`function(*arguments)`."""

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """`function(item)` of each, in order; `function` calls the engine in its turn."""


class Direct:
    """An operation of torch's at a time, with all of torch's threads."""

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """See `Engine`."""
        return function(*arguments)

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """See `Engine`."""
        return [function(item) for item in items]


directly = Direct()
