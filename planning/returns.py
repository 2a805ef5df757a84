"""Returns and tracking costs of predicted trajectories, and the choice among candidates by them.

Paper, section 3.2; Algorithm 1, lines 6, 7 and 10. Pure functions of tensors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning.checks import NoFiniteCandidateError
from cavin_pyro.planning.protocol import Reward, SegmentRollout

REWARD_AT = ("path", "subgoals")
END, FIRST_PUSH = "end", "first_push"  # where motions are compared with a subgoal


class Progress(NamedTuple):
    """The cumulative reward of candidates so far, in any batch `[...]`; a terminated candidate earns no more."""

    returns: Tensor  # [...] cumulative reward so far; -inf once a prediction or a reward was not finite
    succeeded: Tensor  # [...] bool
    failed: Tensor  # [...] bool, never together with `succeeded`
    segments: Tensor  # [...] int64: segments entered while active

    @property
    def active(self) -> Tensor:
        """`[...]` bool: neither succeeded nor failed."""
        return ~(self.succeeded | self.failed)


def start(centers: Tensor) -> Progress:
    """Progress of candidates without a step, for `centers: [..., M, P]`: fields `[...]`."""
    shape = centers.shape[:-2]
    return Progress(
        returns=centers.new_zeros(shape),
        succeeded=centers.new_zeros(shape, dtype=torch.bool),
        failed=centers.new_zeros(shape, dtype=torch.bool),
        segments=centers.new_zeros(shape, dtype=torch.int64),
    )


def interpolate(start: Tensor, end: Tensor, steps: int) -> Tensor:
    """Straight, evenly timed path of T = `steps` states from `start` (not included) to `end` (included).

    `start`, `end`: `[..., M, D]` -> `[..., T, M, D]`, of which the last equals `end` exactly
    (Algorithm 1, line 6).
    """
    fraction = torch.arange(1, steps + 1, device=end.device, dtype=end.dtype) / steps
    return torch.lerp(start.unsqueeze(-3), end.unsqueeze(-3), fraction[:, None, None])


def advance(progress: Progress, reward: Reward, start: Tensor, centers: Tensor, mask: Tensor) -> Progress:
    """Add the rewards of one segment up to and including the step that ends a plan.

    `progress`: fields `[...]`; `start: [..., M, P]`, the state before the segment;
    `centers: [..., T, M, P]`, the T states of the segment, both as the reward reads them; `mask: [..., M]` bool.
    A step that is both a success and a failure is a failure. A step with a centre (of a real object) or a
    reward that is not finite is a failure with reward -inf, even if the reward function disagrees: no
    comparison holds for NaN, so "no object is in the region" would be a success.
    """
    states = torch.cat([start.unsqueeze(-3), centers], dim=-3)  # [..., T + 1, M, P]
    outcome = reward.along(states, mask)
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


@dataclass(frozen=True)
class CumulativeReward:
    """Scores plans by the reward of all their steps, up to the one that ends a plan.

    reward: the task's. at: `path` evaluates every step of a segment, interpolated ones too (paper); `subgoals` only
    its end, as one step (published code).
    """

    reward: Reward
    at: str = "path"

    def start(self, plans: State) -> Progress:
        return start(plans.centers)

    def advance(self, score_state: Progress, segment: int, before: State, rollout: SegmentRollout) -> Progress:
        path = rollout.path if self.at == "path" else rollout.path[..., -1:, :, :]
        start = before.values(self.reward.reads_features)
        return advance(score_state, self.reward, start, path, before.mask)

    def early_stopped(self, score_state: Progress) -> Tensor:
        """`[B]` bool: no active candidate can still reach a higher return than the best terminated one.

        Always false, unless the reward says what `maximum_return` is.
        """
        ended = torch.where(score_state.active, -torch.inf, score_state.returns).amax(-1)
        most = score_state.returns + self.reward.maximum_return
        possible = torch.where(score_state.active, most, -torch.inf).amax(-1)
        return ended > possible


def squared_distance(states: State, goals: State, *, feature_weight: float = 0.0) -> Tensor:
    """Sum over real objects of the squared distance to their goals: `[...]`.

    `states`, `goals`: `[...]`, whose leading dimensions broadcast; the mask is the goals'. `feature_weight`:
    of squared distances between features; 0 ignores features.
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

    def steps(self, segment_length: int) -> int:
        """After how many of a segment's T actions centres are compared."""
        return segment_length if self.at == END else 1

    def __call__(self, end: State, path: Tensor, subgoal: State) -> Tensor:
        """`[...]`, from the last state `end: [...]` and the centres `path: [..., T, M, P]`.

        Their leading dimensions and those of `subgoal: [...]` broadcast.
        """
        compared = end if self.at == END else end._replace(centers=path[..., 0, :, : end.centers.shape[-1]])
        return squared_distance(compared, subgoal, feature_weight=self.feature_weight)


def select_segment(values: Tensor, number: int | Tensor) -> Tensor:
    """One segment `[B, 1, ...]` of `values: [B, K, ...]`; a tensor `number` is not read on the host."""
    return values.index_select(1, torch.as_tensor(number, device=values.device).reshape(1))


class TrackingState(NamedTuple):
    """The tracking cost of motion candidates so far; fields `[B, n]`."""

    cost: Tensor  # summed over the segments
    executed_cost: Tensor  # of the first segment, which is executed
    finite: Tensor  # bool: all actions are finite

    @property
    def returns(self) -> Tensor:
        """`[B, n]` minus the cost."""
        return torch.where(self.finite & torch.isfinite(self.cost), -self.cost, -torch.inf)

    @property
    def failed(self) -> Tensor:
        """`[B, n]` bool: none, because Algorithm 1 replaces no motions."""
        return torch.zeros_like(self.finite)

    @property
    def active(self) -> Tensor:
        """`[B, n]` bool: all, because line 9 predicts whole sequences."""
        return torch.ones_like(self.finite)


class TrackingCost(NamedTuple):
    """Line 10: squared distance of the predicted states to the chosen subgoals, segment by segment.

    Segments after the end of the chosen effect plan have no subgoal and do not count.
    """

    subgoals: State  # [B, K, M, .]
    segments: Tensor  # [B] int64, 1..K: segments until the effect plan ends
    distance: SubgoalDistance

    def start(self, plans: State) -> TrackingState:
        nothing = plans.centers.new_zeros(plans.batch_shape)
        return TrackingState(nothing, nothing, torch.ones_like(nothing, dtype=torch.bool))

    def advance(self, state: TrackingState, segment: int, before: State, rollout: SegmentRollout) -> TrackingState:
        counts = (segment < self.segments).unsqueeze(-1)  # [B, 1]
        subgoal = self.subgoals.map(lambda field: select_segment(field, segment))  # [B, 1, M, .]
        distance = self.distance(rollout.states, rollout.path, subgoal)
        cost = state.cost + torch.where(counts, distance, 0.0)
        executed = torch.as_tensor(segment == 0, device=counts.device)
        assert rollout.actions is not None
        finite = state.finite & (torch.isfinite(rollout.actions).all(-1).all(-1) | ~counts)
        return TrackingState(cost, torch.where(executed, cost, state.executed_cost), finite)

    def early_stopped(self, state: TrackingState) -> Tensor:
        """`[B]` bool: none, because no sequence ends before the others."""
        return torch.zeros_like(state.finite[:, 0])


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
