"""Motions compared with their subgoal after the first push (our addition to Algorithm 1, line 10)."""

from __future__ import annotations

from dataclasses import dataclass

from cavin_pyro.planning.additions.addition import Addition
from cavin_pyro.planning.protocol import Query
from cavin_pyro.planning.returns import FIRST_PUSH, SubgoalDistance


@dataclass(frozen=True)
class FirstPush(Addition):
    """For callers that plan again after each push: prefers motions whose first push comes closest to the subgoal.

    Where the goal is about all objects and motions are of one segment. Where it is about the target, the target would
    break rules more often.
    """

    for_one_push = True

    def subgoal_distance(self, distance: SubgoalDistance, scene: Query, segments: int) -> SubgoalDistance:
        return distance._replace(at=FIRST_PUSH) if segments == 1 and scene.reward.about == "all" else distance
