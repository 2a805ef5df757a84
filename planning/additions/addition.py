"""The interface of additions to Algorithm 1: five hooks and three flags, all of which change nothing by default."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning.focus import Focus
from cavin_pyro.planning.protocol import Plan, Query, SearchObjective
from cavin_pyro.planning.returns import SubgoalDistance
from cavin_pyro.planning.rollout import Candidates


class ChosenEffect(NamedTuple):
    """The effect plan of line 7, which the motions of lines 8 to 10 follow."""

    subgoals: State  # [B, K, M, .]
    segments: Tensor  # [B] int64, 1..K: segments until the effect plan ends
    succeeded: Tensor  # [B] bool: it reaches the goal


class Choice(NamedTuple):
    """Candidates whose first actions are known: motions at line 10, or the plans of a baseline."""

    scene: Query
    model: Any  # `cavin_pyro.planning.protocol.TransitionModel`
    candidates: Candidates  # [B, N]
    first_actions: Callable[[], Tensor]  # [B, N, T, A], of the first segment
    effect: ChosenEffect | None = None  # which motions follow; None for the plans of a baseline
    distance: SubgoalDistance = SubgoalDistance()  # of motions to its subgoals
    subgoals: State | None = None  # [B, N], the first subgoal of each plan of a baseline


class Addition:
    """What can be added to Algorithm 1 and to the baselines. A subclass overrides the hooks that it needs.

    `planner.additions=[...]` lists additions. Ours act in the order of `ADDITIONS`, the user's own before them.
    """

    stops_early: ClassVar[bool] = False  # a search by reward may stop when no candidate can become the best
    for_one_push: ClassVar[bool] = False  # only for callers that plan again after each action
    for_motions: ClassVar[bool] = False  # only for motions that follow an effect, which baselines do not have

    def focus(self, focus: Focus, scene: Query) -> Focus:
        """The objects that codes, subgoals and actions are about (lines 5, 6, 8 and 9); f predicts all."""
        return focus

    def wrap_objective(self, objective: SearchObjective, scene: Query, effect: ChosenEffect | None) -> SearchObjective:
        """The objective of a search: the cumulative reward (line 7), or with `effect` the tracking cost (line 10)."""
        return objective

    def subgoal_distance(self, distance: SubgoalDistance, scene: Query, segments: int) -> SubgoalDistance:
        """The distance to subgoals, for motions of so many segments (line 10)."""
        return distance

    def rank(self, scores: Tensor, choice: Choice) -> Tensor:
        """Scores `[B, N]`, of which the highest is chosen; -inf leaves a candidate out (line 10)."""
        return scores

    def replan(self, plan: Plan, scene: Query, again: Callable[[Query], Plan]) -> Plan:
        """A plan `[B]` in place of the one that was made, such as one of others that `again` makes for scenes."""
        return plan


HOOKS = ("focus", "wrap_objective", "subgoal_distance", "rank", "replan")
