"""Guidance beyond the horizon (our addition to Algorithm 1, lines 7 and 10, and to the baselines).

Under sparse rewards all plans that miss the goal have the same return. Guidance adds a value to each, from a potential
(Ng, Harada and Russell, ICML 1999): minus the remaining distance to the goal along allowed places. It is 0 at the goal
and nowhere positive, so plans that reach the goal keep their order and rank first. A failed plan gets the lowest
potential of the layout, so guidance never prefers it to another plan.

The value is the expected potential of the state where a plan stops: it continues after each segment with probability
`CONTINUES`, at most to its last state. The last state's potential alone would not reward early progress: plans would
wait, in every plan again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning.additions.addition import Addition, ChosenEffect
from cavin_pyro.planning.checks import UnsuitedError
from cavin_pyro.planning.protocol import (
    Query,
    RemainingDistance,
    SearchObjective,
    SegmentRollout,
    replace_within,
    unwrap,
)
from cavin_pyro.planning.returns import Progress, TrackingState, select_segment

CONTINUES = 0.9  # after each segment; 1 values the last state alone


@dataclass(frozen=True)
class Guidance(Addition):
    """Prefers, among plans that miss the goal, those that leave the shortest way to it along allowed places.

    Plans raise UnsuitedError for a reward that does not know the remaining distance to the goal.

    actions_per_length: turns distances into returns, whose unit is an action; a push moves an object by about 0.05.
    """

    actions_per_length: float = 20.0

    def wrap_objective(self, objective: SearchObjective, scene: Query, effect: ChosenEffect | None) -> SearchObjective:
        distance = scene.reward.distance_to_goal()
        if distance is None:
            raise UnsuitedError("the addition guidance needs a reward with a `distance_to_goal`: leave it out")
        if effect is None:
            return GuidedReturn(objective, distance, self.actions_per_length)
        return GuidedTracking(objective, distance, effect.subgoals, effect.segments, ~effect.succeeded)


class GuidedProgress(NamedTuple):
    """The cumulative reward of candidates so far, and the value of their states; fields `[B, n]`."""

    inner: Any  # without guidance
    value: Tensor  # at most 0; in actions
    passed: Tensor  # the part of the value that later segments do not change

    @property
    def returns(self) -> Tensor:
        """Cumulative reward so far plus the value."""
        return self.inner.returns + self.value

    @property
    def failed(self) -> Tensor:
        return self.inner.failed

    @property
    def active(self) -> Tensor:
        return self.inner.active


@dataclass(frozen=True)
class GuidedReturn:
    """Cumulative reward plus the value of the states that a plan leads to: the objective at line 7."""

    objective: SearchObjective
    distance_to_goal: RemainingDistance
    actions_per_length: float = 20.0

    def start(self, plans: State) -> GuidedProgress:
        potential = self.potential(plans.centers, plans.mask)
        return self.valued(self.objective.start(plans), potential, torch.zeros_like(potential), plans.mask)

    def advance(self, state: GuidedProgress, segment: int, before: State, rollout: SegmentRollout) -> GuidedProgress:
        inner = self.objective.advance(state.inner, segment, before, rollout)
        potential = self.potential(rollout.states.centers, before.mask)
        arrives = CONTINUES**segment  # the probability that the plan comes so far
        passed = state.passed + (1.0 - CONTINUES) * arrives * potential
        return self.valued(inner, passed + CONTINUES * arrives * potential, passed, before.mask)

    def potential(self, centers: Tensor, mask: Tensor) -> Tensor:
        """Minus the distance to the goal, in actions: `[B, n]`."""
        return -self.actions_per_length * self.distance_to_goal(centers, mask)

    def valued(self, inner: Any, value: Tensor, passed: Tensor, mask: Tensor) -> GuidedProgress:
        """The state of plans with that value, if they have not ended."""
        progress = unwrap(inner, Progress)
        lowest = -self.actions_per_length * self.distance_to_goal.longest(mask)
        value = torch.where(progress.failed, lowest, torch.where(progress.succeeded, 0.0, value))
        return GuidedProgress(inner, value, passed)

    def early_stopped(self, state: GuidedProgress) -> Tensor:
        """`[B]` bool: as without guidance, but ended plans count with their value; active ones can lose theirs."""

        def with_value(progress: Progress) -> Progress:
            return progress._replace(returns=torch.where(progress.active, progress.returns, state.returns))

        return self.objective.early_stopped(replace_within(state.inner, Progress, with_value))


class GuidedTracking(NamedTuple):
    """The tracking cost of line 10, which grows where f ends farther from the goal than the subgoal.

    A tracking cost alone has no direction: three centimetres short of a subgoal cost as much as three beyond it. Only
    plans that miss the goal are guided; the motions of a plan that reaches it are ranked as without guidance.
    """

    objective: SearchObjective
    distance_to_goal: RemainingDistance
    subgoals: State  # [B, K, M, .]
    segments: Tensor  # [B] int64: segments until the effect plan ends
    guided: Tensor  # [B] bool: the chosen effect plan misses the goal

    def start(self, plans: State) -> Any:
        return self.objective.start(plans)

    def advance(self, state: Any, segment: int, before: State, rollout: SegmentRollout) -> Any:
        after = self.objective.advance(state, segment, before, rollout)
        counts = (self.guided & (segment < self.segments)).unsqueeze(-1)  # [B, 1]
        subgoal = self.subgoals.map(lambda field: select_segment(field, segment))  # [B, 1, M, .]
        left = self.distance_to_goal(rollout.states.centers, before.mask)
        behind = left - self.distance_to_goal(subgoal.centers, subgoal.mask)
        cost = torch.where(counts, behind.clamp(min=0.0).square(), 0.0)
        return replace_within(after, TrackingState, lambda tracking: tracking._replace(cost=tracking.cost + cost))

    def early_stopped(self, state: Any) -> Tensor:
        return self.objective.early_stopped(state)
