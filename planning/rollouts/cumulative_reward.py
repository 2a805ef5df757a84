"""Cumulative reward, the objective of effect codes and pushes (paper, section 3.2, and Algorithm 1, line 7)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning.protocol import BoundedReward, Outcome, RewardFunction
from planning.rollouts import returns
from planning.rollouts.returns import Progress
from planning.rollouts.segment import SegmentRollout

REWARD_AT = ("path", "subgoals")
STRIDE_PENALTY = -100.0  # of a step, as for a violation (published code)


class StepOutcome(NamedTuple):
    """The `Outcome` of steps in any batch `[...]`."""

    reward: Tensor
    success: Tensor
    failure: Tensor


@dataclass(frozen=True)
class CumulativeReward:
    """Scores plans by the reward of all their steps, up to the one that ends a plan.

    reward: the task's. at: `path` evaluates every step of a segment, interpolated ones too (paper); `subgoals` only
    its end, as one step (published code).

    Raises ValueError for an unknown `at`.
    """

    reward: RewardFunction
    at: str = "path"

    def __post_init__(self) -> None:
        if self.at not in REWARD_AT:
            raise ValueError(f"unknown reward_at '{self.at}': choose {' or '.join(REWARD_AT)}")

    def start(self, plans: State) -> Progress:
        """Progress of candidates without a segment, `plans: [B, n]`."""
        return returns.start(plans.centers)

    def advance(self, score_state: Progress, segment: int, before: State, rollout: SegmentRollout) -> Progress:
        """Progress after one more segment from `before: [B, n]`."""
        path = rollout.path if self.at == "path" else rollout.path[..., -1:, :, :]
        return returns.advance(score_state, self.reward, before.centers, path, before.mask)

    def early_stopped(self, score_state: Progress) -> Tensor:
        """`[B]` bool: no active candidate can still reach a higher return than the best terminated one.

        Always false, unless the reward function is a `planning.protocol.BoundedReward`.
        """
        ended = torch.where(score_state.active, -torch.inf, score_state.returns).amax(-1)
        possible = torch.where(
            score_state.active, score_state.returns + maximum_return_of(self.reward), -torch.inf
        ).amax(-1)
        return ended > possible


@dataclass(frozen=True)
class StrideLimits:
    """A reward function that ends plans whose strides are implausible (published code; not in the paper).

    A stride fails if every object moves less than `shortest`, or any farther than `longest` metres; its reward is
    then -100. `of`: `segments` (published: 0.1 m and 0.3 m from subgoal to subgoal) or `pushes` (0.01 m and 0.15 m).

    Raises ValueError unless the limits are two, in order, not negative.
    """

    reward: RewardFunction
    limits: Sequence[float]  # shortest and longest, in metres
    of: str

    def __post_init__(self) -> None:
        limits = self.limits
        numbers = isinstance(limits, list | tuple) and all(isinstance(limit, int | float) for limit in limits)
        if not numbers or len(limits) != 2 or not 0 <= limits[0] < limits[1]:
            raise ValueError(f"stride_limits must be two distances in metres, low then high, not {limits}")
        object.__setattr__(self, "limits", tuple(limits))

    @property
    def maximum_return(self) -> float:
        """Upper bound on any return, as without limits, which only lower returns."""
        return maximum_return_of(self.reward)

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> Outcome:
        """Evaluate the steps `previous: [..., T, M, 3]` to `centers: [..., T, M, 3]` metres of whole segments."""
        outcome = self.reward(previous, centers, mask)
        if self.of == "pushes":
            outside = self._outside(previous, centers, mask)
        else:
            whole = self._outside(previous[..., 0, :, :], centers[..., -1, :, :], mask[..., -1, :])
            outside = torch.zeros_like(outcome.failure)
            outside[..., 0] = whole  # from its first step on: no reward counts in a segment that fails
        outside = outside & ~outcome.failure
        return StepOutcome(
            torch.where(outside, STRIDE_PENALTY, outcome.reward),
            outcome.success & ~outside,
            outcome.failure | outside,
        )

    def _outside(self, before: Tensor, after: Tensor, mask: Tensor) -> Tensor:
        shortest, longest = self.limits
        strides = (after - before).norm(dim=-1)
        short = ((strides < shortest) | ~mask).all(-1)
        return short | ((strides > longest) & mask).any(-1)


def maximum_return_of(reward: RewardFunction) -> float:
    """Upper bound on any return; infinite if unknown."""
    return reward.maximum_return if isinstance(reward, BoundedReward) else math.inf
