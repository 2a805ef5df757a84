"""Backends, which run planning's inner functions and loop over chunks of environments.

An inner function is a pure function of tensors, named tuples of tensors, and constants (a model, a reward, a number
from the options), which are compared by `==`. Callers sample random numbers and pass them in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class Backend(Protocol):
    """Runs functions: `eager`, `planning.backends.compiled.Compiled`, or `planning.backends.cuda_graphs.CudaGraphs`."""

    @property
    def native(self) -> bool:
        """Whether all functions so far ran as native code."""

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """`function(*arguments)`."""

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """`function(item)` of each item, in order; `function` may call the backend."""


class Eager:
    """Eager execution, one operation of torch at a time."""

    native = False

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """See `Backend`."""
        return function(*arguments)

    def each(self, function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """See `Backend`."""
        return [function(item) for item in items]


eager = Eager()
