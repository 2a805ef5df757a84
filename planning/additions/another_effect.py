"""Other plans where no motion reaches the first subgoal (our addition to Algorithm 1, lines 5 to 10).

h may believe in effects that no motion brings about, and the search for a high return finds them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from operator import itemgetter
from typing import ClassVar

from cavin_pyro.models.checks import check_number
from cavin_pyro.planning import records
from cavin_pyro.planning.additions.addition import Addition
from cavin_pyro.planning.checks import NoFiniteCandidateError
from cavin_pyro.planning.protocol import Plan, Query
from cavin_pyro.planning.returns import squared_distance


@dataclass(frozen=True)
class AnotherEffect(Addition):
    """Plans again, from line 5, until a plan reaches the goal and f ends its first segment near the first subgoal.

    Of all plans it takes one that reaches the goal by h, and of these the one whose segment ends nearest.

    tolerance: in the world's unit, of all positions together, without features; 0.03 are 3 cm on the tabletop.
    attempts: plans, the first one included. Raises ValueError for a negative tolerance, and counts below 1.
    """

    for_motions: ClassVar[bool] = True

    tolerance: float = 0.03
    attempts: int = 4

    def __post_init__(self) -> None:
        check_number("tolerance", self.tolerance)
        check_number("attempts", self.attempts, 1, whole=True)

    def replan(self, plan: Plan, scene: Query, again: Callable[[Query], Plan]) -> Plan:
        """See `Addition`: each environment alone, since its plan must not depend on its neighbours'."""
        taken = []
        for number in range(len(scene.generators)):
            one = slice(number, number + 1)
            alone = scene._replace(
                state=scene.state.scene(one),
                generators=scene.generators[one],
                observed=scene.observed and records.apply(scene.observed, itemgetter(one)),
            )
            best = records.apply(plan, itemgetter(one))
            for _ in range(self.attempts - 1):
                if _shortfall(best) <= (False, self.tolerance):
                    break
                with suppress(NoFiniteCandidateError):  # of this attempt
                    best = min(best, again(alone), key=_shortfall)
            taken.append(best)
        return records.join(taken, dimension=0)


def _shortfall(plan: Plan) -> tuple[bool, float]:
    """Whether a plan of one environment misses the goal, and how far f ends its first segment from the subgoal."""
    subgoal = plan.subgoals.step(0)
    reached = subgoal._replace(centers=plan.predicted_centers[:, plan.actions.shape[1] - 1])
    return not plan.expected_success, math.sqrt(squared_distance(reached, subgoal))
