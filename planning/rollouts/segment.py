"""One segment of candidates, and the protocols of search spaces and objectives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from models.state import State


class SegmentRollout(NamedTuple):
    """One segment of n candidates, T steps long."""

    code: Tensor  # [B, n, D] effect or motion codes; or the concatenated T raw pushes
    actions: Tensor | None  # [B, n, T, 4], if the search space has actions
    states: State  # [B, n, M, .] at the end of the segment
    path: Tensor  # [B, n, T, M, 3] metres, after every step


class SearchSpace(Protocol):
    """Effect codes, motion codes or raw pushes. A named tuple, so that a backend can compile it."""

    @property
    def dimension(self) -> int:
        """D, the dimension of the noise of one segment."""

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        """Roll out segment number `segment` of candidates in the states `plans: [B, n]`.

        `here`: the same states, or `[B, 1]` if all are equal. `noise: [B, n, D]`, standard normal, determines
        the segment; None samples the prior with the `generators`.
        """


class ScoreState(Protocol):
    """The running score of candidates: a named tuple of fields `[B, n]`."""

    @property
    def returns(self) -> Tensor:
        """`[B, n]`, higher is better; -inf for candidates with a prediction that is not finite."""

    @property
    def failed(self) -> Tensor:
        """`[B, n]` bool: terminated by a failure, so that a copy of an active candidate may replace it."""

    @property
    def active(self) -> Tensor:
        """`[B, n]` bool: not terminated."""


class Objective(Protocol):
    """Scores candidates. A named tuple or a frozen dataclass, so that a backend can compile it."""

    def start(self, plans: State) -> Any:
        """`ScoreState` of candidates without a segment, `plans: [B, n]`."""

    def advance(self, score_state: Any, segment: int, before: State, rollout: SegmentRollout) -> Any:
        """`ScoreState` after one more segment, which begins at `before: [B, n]`."""

    def early_stopped(self, score_state: Any) -> Tensor:
        """`[B]` bool: no active candidate can still reach a higher return than the best terminated one."""


class SegmentRecord(NamedTuple):
    """One segment of R candidates."""

    noise: Tensor | None  # [B, R, D]
    rollout: SegmentRollout
    score_state: Any  # after the segment


def select_segment(values: Tensor, number: int | Tensor) -> Tensor:
    """One segment `[B, 1, ...]` of `values: [B, K, ...]`; a tensor `number` is not read on the host."""
    return values.index_select(1, torch.as_tensor(number, device=values.device).reshape(1))


def actions_of(segment: SegmentRecord) -> Tensor:
    """The actions `[B, R, T, 4]` of a segment, for a search space that has them."""
    assert segment.rollout.actions is not None
    return segment.rollout.actions
