"""Plans are made again where no motion reaches the first subgoal, for the environments that need it alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning import CavinPlanner, Plan
from cavin_pyro.planning.additions import AnotherEffect

AT = AnotherEffect(tolerance=0.03, attempts=8)


def missed(plan: Plan) -> Tensor:
    """How far f ends the first segment from the first subgoal."""
    return (plan.predicted_centers[:, 2] - plan.subgoals.centers[:, 0]).norm(dim=-1)[:, 0]


@pytest.fixture
def planned(toy: SimpleNamespace) -> Any:
    class Optimistic(toy.PointMass):  # type: ignore[misc]
        """Effects with a positive second code end 10 cm farther along than motions do."""

        def subgoal(self, state: State, effect_code: Tensor) -> State:
            reached = super().subgoal(state, effect_code)
            farther = 0.1 * (effect_code[..., 1] > 0)[..., None, None] * torch.tensor([1.0, 0.0, 0.0])
            return reached._replace(centers=reached.centers + farther)

    def plan(*additions: Any, starts: Any = ((0.0, 0.0),) * 8, seeds: Any = range(8)) -> Plan:
        planner = CavinPlanner(Optimistic(), samples=64, horizon=6, additions=additions)
        state = toy.scenes([[start] for start in starts])
        return planner.plan(state, reward=toy.GoalDisc((0.2, 0.0), radius=0.1), generators=toy.generators(*seeds))

    return plan


def test_effects_that_no_motion_brings_about_make_way_for_others(planned: Any) -> None:
    first, again = planned(), planned(AT)
    assert (missed(first) > 0.03).sum() >= 3
    assert (missed(again) <= 0.03).all() and again.expected_success.all()
    good = missed(first) <= 0.03
    assert good.any() and torch.equal(first.planned_actions[good], again.planned_actions[good])
    assert torch.equal(planned(AnotherEffect(0.03, 1)).planned_actions, first.planned_actions)


def test_a_plan_does_not_depend_on_its_neighbours(planned: Any) -> None:
    both, alone = (
        planned(AT, starts=[(0.0, 0.0), (0.1, 0.0)], seeds=[1, 2]),
        planned(AT, starts=[(0.1, 0.0)], seeds=[2]),
    )
    torch.testing.assert_close(both.planned_actions[1], alone.planned_actions[0])


def test_where_no_plan_reaches_the_goal_the_nearest_to_its_subgoal_is_taken(planned: Any) -> None:
    one, many = (planned(AnotherEffect(0.0, attempts), starts=[(9.0, 9.0)], seeds=[0]) for attempts in (1, 8))
    assert not many.expected_success.any() and missed(many) < missed(one)
