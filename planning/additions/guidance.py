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
from cavin_pyro.planning.protocol import DistanceToGoal, GuidingReward, Objective, RewardFunction, SegmentRollout
from cavin_pyro.planning.returns import CumulativeReward, Progress
from cavin_pyro.planning.rollout import select_segment

GUIDANCE = ("none", "layout")
CONTINUES = 0.9  # after each segment; 1 values the last state alone
PUSHES_PER_METRE = 20.0  # turns metres into returns, whose unit is a push: one moves an object by about 0.05 m


class GuidedProgress(NamedTuple):
    """The cumulative reward of candidates so far, and the value of their states; fields `[B, n]`."""

    progress: Progress
    value: Tensor  # at most 0; in pushes
    passed: Tensor  # the part of the value that later segments do not change

    @property
    def returns(self) -> Tensor:
        """Cumulative reward so far plus the value."""
        return self.progress.returns + self.value

    @property
    def earned(self) -> Tensor:
        """Cumulative reward alone."""
        return self.progress.returns

    @property
    def succeeded(self) -> Tensor:
        """bool: see `Progress`."""
        return self.progress.succeeded

    @property
    def failed(self) -> Tensor:
        """bool: see `Progress`."""
        return self.progress.failed

    @property
    def segments(self) -> Tensor:
        """int64: see `Progress`."""
        return self.progress.segments

    @property
    def active(self) -> Tensor:
        """bool: neither succeeded nor failed."""
        return self.progress.active


@dataclass(frozen=True)
class GuidedReturn:
    """Cumulative reward plus the value of the states that a plan leads to: the objective at line 7."""

    objective: CumulativeReward
    distance_to_goal: DistanceToGoal

    def start(self, plans: State) -> GuidedProgress:
        """Progress of candidates without a segment, `plans: [B, n]`."""
        potential = self.potential(plans.centers, plans.mask)
        return self.valued(self.objective.start(plans), potential, torch.zeros_like(potential), plans.mask)

    def advance(
        self, score_state: GuidedProgress, segment: int, before: State, rollout: SegmentRollout
    ) -> GuidedProgress:
        """Progress after one more segment from `before: [B, n]`."""
        progress = self.objective.advance(score_state.progress, segment, before, rollout)
        potential = self.potential(rollout.states.centers, before.mask)
        arrives = CONTINUES**segment  # the probability that the plan comes so far
        passed = score_state.passed + (1.0 - CONTINUES) * arrives * potential
        return self.valued(progress, passed + CONTINUES * arrives * potential, passed, before.mask)

    def potential(self, centers: Tensor, mask: Tensor) -> Tensor:
        """Minus the distance to the goal, in pushes: `[B, n]`."""
        return -PUSHES_PER_METRE * self.distance_to_goal(centers, mask)

    def valued(self, progress: Progress, value: Tensor, passed: Tensor, mask: Tensor) -> GuidedProgress:
        """The state of plans with that value, if they have not ended."""
        lowest = -PUSHES_PER_METRE * self.distance_to_goal.longest(mask)
        value = torch.where(progress.failed, lowest, torch.where(progress.succeeded, 0.0, value))
        return GuidedProgress(progress, value, passed)

    def early_stopped(self, score_state: GuidedProgress) -> Tensor:
        """`[B]` bool: as without guidance, but ended plans count with their value; active ones can lose theirs."""
        progress = score_state.progress
        ended = torch.where(progress.active, progress.returns, score_state.returns)
        return self.objective.early_stopped(progress._replace(returns=ended))


class GuidedTracking(NamedTuple):
    """The tracking cost of line 10, which grows where f ends farther from the goal than the subgoal.

    A tracking cost alone has no direction: three centimetres short of a subgoal cost as much as three beyond it. Only
    plans that miss the goal are guided; the motions of a plan that reaches it are ranked as without guidance.
    """

    objective: Any  # `cavin_pyro.planning.cavin.TrackingCost`
    distance_to_goal: DistanceToGoal
    guided: Tensor  # [B] bool: the chosen effect plan misses the goal

    def start(self, plans: State) -> Any:
        """The state of candidates without a segment, `plans: [B, n]`."""
        return self.objective.start(plans)

    def advance(self, state: Any, segment: int, before: State, rollout: SegmentRollout) -> Any:
        """The state after one more segment from `before: [B, n]`."""
        tracking = self.objective.advance(state, segment, before, rollout)
        counts = (self.guided & (segment < self.objective.segments)).unsqueeze(-1)  # [B, 1]
        subgoal = self.objective.subgoals.map(lambda field: select_segment(field, segment))  # [B, 1, M, .]
        left = self.distance_to_goal(rollout.states.centers, before.mask)
        behind = left - self.distance_to_goal(subgoal.centers, subgoal.mask)
        return tracking._replace(cost=tracking.cost + torch.where(counts, behind.clamp(min=0.0).square(), 0.0))

    def early_stopped(self, state: Any) -> Tensor:
        """As without guidance."""
        return self.objective.early_stopped(state)


def check_guidance(guidance: str) -> None:
    """Raise ValueError for an unknown `guidance`."""
    if guidance not in GUIDANCE:
        raise ValueError(f"unknown guidance '{guidance}': choose {' or '.join(GUIDANCE)}")


def distance_to_goal_of(guidance: str, reward: RewardFunction) -> DistanceToGoal | None:
    """The distance to the goal in this episode; None without guidance.

    Raises ValueError if the reward function knows none.
    """
    if guidance == "none":
        return None
    if not isinstance(reward, GuidingReward):
        raise ValueError(
            f"guidance='{guidance}' needs a reward function with a `distance_to_goal`: choose guidance='none'"
        )
    return reward.distance_to_goal


def guided_return(objective: CumulativeReward, distance_to_goal: DistanceToGoal | None) -> Objective:
    """The objective of effect codes and pushes, guided if there is a distance to the goal."""
    return objective if distance_to_goal is None else GuidedReturn(objective, distance_to_goal)


def guided_tracking(cost: Objective, distance_to_goal: DistanceToGoal | None, succeeded: Tensor) -> Objective:
    """The tracking cost of motions, guided if a distance is given; `succeeded: [B]` bool, the effect plan's."""
    return cost if distance_to_goal is None else GuidedTracking(cost, distance_to_goal, ~succeeded)
