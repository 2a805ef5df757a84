"""Another effect where no motion moves anything."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning import CavinPlanner, Plan
from cavin_pyro.planning.additions import EffectRetries
from cavin_pyro.planning.additions.effect_retries import is_unmoved, leave_out_similar
from tests.planning.conftest import PointMass

GOAL = (0.5, 0.0)


class Walled(PointMass):
    """f knows of a wall: objects with x > 0 go no farther in x; h does not know it."""

    def next_state(self, state: State, action: Tensor) -> State:
        at_wall = (state.centers[..., :1, 0] > 0).unsqueeze(-1)
        ahead = (action[..., 2] > 0).unsqueeze(-1).unsqueeze(-1)
        after = super().next_state(state, action)
        return after._replace(centers=torch.where(at_wall & ahead, state.centers, after.centers))


def planner(*additions: Any, samples: int = 64, horizon: int = 6) -> CavinPlanner:
    additions = "failure_avoidance", *additions
    return CavinPlanner(Walled(noise=0.0), samples, horizon, "first_segment", additions=additions)


def moved(plan: Plan, state: State) -> Tensor:
    away = plan.predicted_centers[:, 2] - state.centers
    return away[..., :2].norm(dim=-1).amax(-1)


def test_where_nothing_moves_another_effect_is_tried(toy: SimpleNamespace) -> None:
    state, reward = toy.scenes([[(0.01, 0.0)]]), toy.GoalDisc(goal=GOAL, dense=True)
    planners = planner(), planner(EffectRetries(3))
    stuck, tried = (one.plan(state, reward=reward, generators=toy.generators(3)) for one in planners)
    assert moved(stuck, state) == 0.0
    assert moved(tried, state) > 0.02
    first, other = ((plan.subgoals.centers[:, 0] - state.centers)[0, 0, :2] for plan in (stuck, tried))
    assert first[0] > 0.02  # through the wall
    assert torch.cosine_similarity(first, other, dim=0) < 0.5


def test_the_other_effect_reaches_the_goal_though_the_search_has_stopped_at_the_first(toy: SimpleNamespace) -> None:
    state = toy.scenes([[(0.01, 0.0)]])
    # One segment through the wall reaches the goal, and ends the search under a sparse reward; a way round takes more.
    reward = toy.GoalDisc(goal=(0.12, 0.0))
    for seed in range(5):
        own = planner("early_stopping", EffectRetries(3), samples=256, horizon=12)
        tried = own.plan(state, reward=reward, generators=toy.generators(seed))
        assert moved(tried, state) > 0.02
        assert tried.expected_success.item() and tried.segments.item() > 1


@pytest.mark.parametrize("more", [[], ["early_stopping"]])
def test_a_plan_does_not_depend_on_whether_its_neighbours_are_stuck(toy: SimpleNamespace, more: list[str]) -> None:
    places = [[(0.01, 0.0)], [(-0.4, 0.0)], [(0.01, 0.2)]]
    one, reward = planner(EffectRetries(3), *more), toy.GoalDisc(goal=GOAL, dense=True)
    together = toy.generators(3, 4, 5)
    plans = one.plan(toy.scenes(places), reward=reward, generators=together)
    for number, place in enumerate(places):
        alone = toy.generators(3 + number)
        plan = one.plan(toy.scenes([place]), reward=reward, generators=alone)
        assert torch.equal(plan.actions[0], plans.actions[number])
        assert torch.equal(plan.subgoals.centers[0], plans.subgoals.centers[number])
        assert torch.equal(alone[0].get_state(), together[number].get_state())


def test_only_an_effect_that_asks_for_a_motion_can_be_unmoved() -> None:
    state = State(torch.zeros(4, 2, 3), torch.zeros(4, 2, 1), torch.tensor([[True, False]]).expand(4, 2))
    subgoals, predicted = torch.zeros(4, 2, 3), torch.zeros(4, 2, 3)
    subgoals[0, 0, 0] = 0.05  # asked for, and nothing moves
    subgoals[1, 0, 0], predicted[1, 0, 1] = 0.05, 0.03  # something moves, if elsewhere
    subgoals[2, 0, 0] = 0.01  # nothing is asked for
    subgoals[3, 1, 0] = 0.05  # of padding
    assert is_unmoved(state, subgoals, predicted).tolist() == [True, False, False, False]


def test_effects_in_another_direction_stay_and_those_that_do_nothing_go() -> None:
    moves = torch.tensor([[0.05, 0.0], [0.08, 0.01], [0.0, 0.05], [-0.05, 0.0], [0.001, 0.002], [0.03, 0.08]])
    moves = moves.view(1, 6, 1, 2)
    scores = torch.arange(6.0).unsqueeze(0)
    left = leave_out_similar(scores, moves, torch.tensor([0]), torch.tensor([True]))
    assert torch.isfinite(left).tolist() == [[False, False, True, True, False, True]]
    assert torch.equal(left[torch.isfinite(left)], scores[torch.isfinite(left)])
    assert torch.equal(leave_out_similar(scores, moves, torch.tensor([0]), torch.tensor([False])), scores)
    same = moves[:, :2]
    assert torch.equal(leave_out_similar(scores[:, :2], same, torch.tensor([0]), torch.tensor([True])), scores[:, :2])
