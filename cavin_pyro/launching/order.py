"""The order in which results of jobs are yielded."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, TypeVar

Result = TypeVar("Result")


class Order(Generic[Result]):
    """As results come, or in the order of the jobs, for which early ones are kept.

    Attributes:
        yielded: how many results were; if `ordered`, the number of the next one.
    """

    def __init__(self, *, ordered: bool) -> None:
        self._ordered = ordered
        self._early: dict[int, Result] = {}
        self.yielded = 0

    def add(self, number: int, result: Result) -> Iterator[tuple[int, Result]]:
        """Add the result of a job; yield the number and the result of each job whose turn it is now."""
        self._early[number] = result
        turn = self.yielded if self._ordered else number
        while turn in self._early:
            yield turn, self._early.pop(turn)
            self.yielded += 1
            turn += 1
