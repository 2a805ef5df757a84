"""Returns of predicted trajectories, and the choice among candidates by them (paper, section 3.2; Algorithm 1, line 7).

Pure functions of tensors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning.checks import NoFiniteCandidateError
from cavin_pyro.planning.protocol import BoundedReward, Outcome, PathReward, RewardFunction, SegmentRollout

REWARD_AT = ("path", "subgoals")
STRIDE_PENALTY = -100.0  # of a step, as for a violation (published code)
AUTO, END, FIRST_PUSH = "auto", "end", "first_push"  # where motions are compared with a subgoal


class Progress(NamedTuple):
    """The cumulative reward of candidates so far, in any batch `[...]`; a terminated candidate earns no more."""

    returns: Tensor  # [...] cumulative reward so far; -inf once a prediction or a reward was not finite
    succeeded: Tensor  # [...] bool
    failed: Tensor  # [...] bool, never together with `succeeded`
    segments: Tensor  # [...] int64: segments entered while active

    @property
    def earned(self) -> Tensor:
        """`[...]` cumulative reward, which is all that plans are ranked by without guidance."""
        return self.returns

    @property
    def active(self) -> Tensor:
        """`[...]` bool: neither succeeded nor failed."""
        return ~(self.succeeded | self.failed)


def start(centers: Tensor) -> Progress:
    """Progress of candidates without a step, for `centers: [..., M, 3]`: fields `[...]`."""
    shape = centers.shape[:-2]
    return Progress(
        returns=centers.new_zeros(shape),
        succeeded=centers.new_zeros(shape, dtype=torch.bool),
        failed=centers.new_zeros(shape, dtype=torch.bool),
        segments=centers.new_zeros(shape, dtype=torch.int64),
    )


def interpolate(start: Tensor, end: Tensor, steps: int) -> Tensor:
    """Straight, evenly timed path of T = `steps` states from `start` (not included) to `end` (included).

    `start`, `end`: `[..., M, 3]` metres -> `[..., T, M, 3]`, of which the last equals `end` exactly
    (Algorithm 1, line 6).
    """
    fraction = torch.arange(1, steps + 1, device=end.device, dtype=end.dtype) / steps
    return torch.lerp(start.unsqueeze(-3), end.unsqueeze(-3), fraction[:, None, None])


def advance(progress: Progress, reward: RewardFunction, start: Tensor, centers: Tensor, mask: Tensor) -> Progress:
    """Add the rewards of one segment up to and including the step that ends a plan.

    `progress`: fields `[...]`; `start: [..., M, 3]` metres, the state before the segment;
    `centers: [..., T, M, 3]` metres, the T states of the segment; `mask: [..., M]` bool.
    A step that is both a success and a failure is a failure. A step with a centre (of a real object) or a
    reward that is not finite is a failure with reward -inf, even if the reward function disagrees: no
    comparison holds for NaN, so "no object is in the region" would be a success.
    """
    states = torch.cat([start.unsqueeze(-3), centers], dim=-3)  # [..., T + 1, M, 3]
    outcome = judge(reward, states, mask)
    # A sum is finite only if all of its terms are.
    real = centers.where(mask[..., None, :, None], 0.0)
    finite = torch.isfinite(outcome.reward + real.sum((-2, -1)))
    failure = outcome.failure | ~finite
    success = outcome.success & ~failure
    earned = torch.where(finite, outcome.reward, -torch.inf)
    gained, succeeded, failed = torch.zeros_like(progress.returns), progress.succeeded, progress.failed
    for step in range(centers.shape[-3]):
        counts = ~(succeeded | failed)
        gained = gained + torch.where(counts, earned[..., step], 0.0)
        succeeded = succeeded | (counts & success[..., step])
        failed = failed | (counts & failure[..., step])
    return Progress(progress.returns + gained, succeeded, failed, progress.segments + progress.active)


def judge(reward: RewardFunction, states: Tensor, mask: Tensor) -> Outcome:
    """The reward of every step of paths: `states: [..., T + 1, M, 3]` metres, `mask: [..., M]` -> fields `[..., T]`."""
    if isinstance(reward, PathReward):
        return reward.along(states, mask)
    previous, centers = states[..., :-1, :, :], states[..., 1:, :, :]
    return reward(previous, centers, mask.unsqueeze(-2).expand(centers.shape[:-1]))


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
        return start(plans.centers)

    def advance(self, score_state: Progress, segment: int, before: State, rollout: SegmentRollout) -> Progress:
        """Progress after one more segment from `before: [B, n]`."""
        path = rollout.path if self.at == "path" else rollout.path[..., -1:, :, :]
        return advance(score_state, self.reward, before.centers, path, before.mask)

    def early_stopped(self, score_state: Progress) -> Tensor:
        """`[B]` bool: no active candidate can still reach a higher return than the best terminated one.

        Always false, unless the reward function is a `cavin_pyro.planning.protocol.BoundedReward`.
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


def squared_distance(states: State, goals: State, *, feature_weight: float = 0.0) -> Tensor:
    """Sum over real objects of the squared distance to their goals: `[...]` square metres.

    `states`, `goals`: `[...]`, whose leading dimensions broadcast; the mask is the goals'. `feature_weight`:
    square metres per squared unit of distance between features; 0 ignores features.
    """
    per_object = (states.centers - goals.centers).square().sum(-1)
    if feature_weight:
        per_object = per_object + feature_weight * (states.features - goals.features).square().sum(-1)
    return torch.where(goals.mask, per_object, 0.0).sum(-1)


class SubgoalDistance(NamedTuple):
    """How far a segment is from its subgoal (Algorithm 1, line 10).

    feature_weight: as in `squared_distance`, of the features at the end of what is rolled out. at: where centres are
    compared, at the `end` of the segment (paper) or after its `first_push`.
    """

    feature_weight: float = 0.0
    at: str = END

    def pushes(self, segment_length: int) -> int:
        """After how many of a segment's T pushes centres are compared."""
        return segment_length if self.at == END else 1

    def __call__(self, end: State, path: Tensor, subgoal: State) -> Tensor:
        """`[...]` square metres, from the last state `end: [...]` and the centres `path: [..., T, M, 3]` metres.

        Their leading dimensions and those of `subgoal: [...]` broadcast.
        """
        compared = end if self.at == END else end._replace(centers=path[..., 0, :, :])
        return squared_distance(compared, subgoal, feature_weight=self.feature_weight)


def prefer(scores: Tensor, preferred: Tensor) -> Tensor:
    """Scores `[B, N]` with -inf for candidates outside `preferred: [B, N]`, in environments with a preferred one.

    A preferred candidate without a finite score does not count.
    """
    preferred = preferred & torch.isfinite(scores)
    return torch.where(preferred | ~preferred.any(-1, keepdim=True), scores, -torch.inf)


def best_of(scores: Tensor, what: str) -> Tensor:
    """Number of the plan with the highest score, the first among equals: `[B]` int64, from `scores: [B, N]`.

    Scores that are not finite lose. Raises ValueError with the environment and `what` was ranked if none is finite:
    no plan from such a choice may reach a robot.
    """
    finite = torch.isfinite(scores)
    infinite = (~finite.any(-1)).nonzero().flatten().tolist()
    if infinite:
        raise NoFiniteCandidateError(
            infinite[0],
            f"none of the {scores.shape[-1]} {what} is finite; "
            "check the observed state, the reward and the model's weights",
        )
    return torch.where(finite, scores, -torch.inf).argmax(-1)
