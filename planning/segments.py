"""One segment of plans, and what has to say which segments there are and what they are worth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from models.state import State


class Stretch(NamedTuple):
    """One segment of n plans."""

    code: Tensor  # [B, n, D] effect or motion codes; raw pushes have the T pushes in a row
    actions: Tensor | None  # [B, n, T, 4], where there are any
    states: State  # [B, n, M, .] at the end
    path: Tensor  # [B, n, T, M, 3] metres, after every step


class Level(Protocol):
    """What is searched: effect codes, motion codes or raw pushes."""

    @property
    def dimension(self) -> int:
        """D, the numbers that settle one segment."""

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> Stretch:
        """Segment number `segment` of plans that have come to `plans: [B, n]`.

        `here`: the same, or `[B, 1]` where all are in one state. `noise: [B, n, D]`, standard normal, says
        which segment; None draws from the prior.
        """


class Standing(Protocol):
    """How plans stand: a named tuple of fields `[B, n]`."""

    @property
    def returns(self) -> Tensor:
        """`[B, n]` the higher the better; -inf for plans with a prediction that is not finite."""

    @property
    def failed(self) -> Tensor:
        """`[B, n]` bool: dead, so that a copy of a living plan may take the place."""

    @property
    def active(self) -> Tensor:
        """`[B, n]` bool: not ended."""


class Score(Protocol):
    """What is wanted of plans."""

    def start(self, plans: State) -> Any:
        """`Standing` of plans that have not begun, `plans: [B, n]`."""

    def advance(self, standing: Any, segment: int, before: State, stretch: Stretch) -> Any:
        """`Standing` after one more segment, which begins at `before: [B, n]`."""

    def settled(self, standing: Any) -> Tensor:
        """`[B]` bool: where no plan that goes on can come to a higher return than the best that has ended."""


class Segment(NamedTuple):
    """What is kept of one segment of R plans."""

    noise: Tensor | None  # [B, R, D]
    stretch: Stretch
    standing: Any  # afterwards


def of_segment(fields: Tensor, number: int | Tensor) -> Tensor:
    """What `fields: [B, K, ...]` hold of one segment: `[B, 1, ...]`. A number that is a tensor needs no look at it."""
    return fields.index_select(1, torch.as_tensor(number, device=fields.device).reshape(1))


def pushes_of(segment: Segment) -> Tensor:
    """The pushes `[B, R, T, 4]` of a segment of a level that has them."""
    assert segment.stretch.actions is not None
    return segment.stretch.actions
