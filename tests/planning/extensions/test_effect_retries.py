"""Another effect where no motion moves anything, or all may fail."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from models.state import State
from planning import CavinPlanner, Plan
from planning.extensions import effect_retries
from planning.extensions.effect_retries import is_unmoved, leave_out_similar, try_other_effects
from planning.plan import Prospects

GOAL = (0.5, 0.0)


def walled(toy: SimpleNamespace) -> object:
    """A point mass whose f knows of a wall: objects with x > 0 go no farther in x; h does not know it."""

    class Walled(toy.PointMass):  # type: ignore[misc, name-defined]
        def next_state(self, state: State, action: Tensor) -> State:
            at_wall = (state.centers[..., :1, 0] > 0).unsqueeze(-1)
            ahead = (action[..., 2] > 0).unsqueeze(-1).unsqueeze(-1)
            after = super().next_state(state, action)
            return after._replace(centers=torch.where(at_wall & ahead, state.centers, after.centers))

    return Walled(noise=0.0)


def planner(toy: SimpleNamespace, retries: int, **options: object) -> CavinPlanner:
    reward = toy.GoalDisc(goal=GOAL, dense=True)
    return toy.plain(walled(toy), reward, 64, 6, "first_segment", effect_retries=retries, **options)


def moved(plan: object, state: State) -> Tensor:
    away = plan.predicted_centers[:, 2] - state.centers  # type: ignore[attr-defined]
    return away[..., :2].norm(dim=-1).amax(-1)


def test_where_nothing_moves_another_effect_is_tried(toy: SimpleNamespace) -> None:
    state = toy.scenes([[(0.01, 0.0)]])
    stuck, tried = (planner(toy, retries).plan(state, toy.generators(3)) for retries in (0, 3))
    assert moved(stuck, state) == 0.0
    assert moved(tried, state) > 0.02
    first, other = ((plan.subgoals.centers[:, 0] - state.centers)[0, 0, :2] for plan in (stuck, tried))
    assert first[0] > 0.02  # through the wall
    assert torch.cosine_similarity(first, other, dim=0) < 0.5


def test_elsewhere_plans_are_as_without(toy: SimpleNamespace) -> None:
    state = toy.scenes([[(-0.4, 0.0)]])
    generators = [toy.generators(3) for _ in range(2)]
    without, tried = (planner(toy, retries).plan(state, own) for retries, own in zip((0, 3), generators, strict=True))
    assert torch.equal(without.actions, tried.actions)
    assert torch.equal(generators[0][0].get_state(), generators[1][0].get_state())


@pytest.mark.parametrize("warm_start", [False, True])
def test_a_plan_does_not_depend_on_whether_its_neighbours_are_stuck(toy: SimpleNamespace, warm_start: bool) -> None:
    places = [[(0.01, 0.0)], [(-0.4, 0.0)], [(0.01, 0.2)]]
    one = planner(toy, 3, warm_start=warm_start)
    together = toy.generators(3, 4, 5)
    plans = one.plan(toy.scenes(places), together)
    for number, place in enumerate(places):
        alone = toy.generators(3 + number)
        plan = one.plan(toy.scenes([place]), alone)
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


def told(toy: SimpleNamespace, failures: float, moves: float) -> Plan:
    """A plan for one environment whose motion fails in this share of its rollouts, and moves the object so far."""
    state = toy.scenes([[(-0.4, 0.0)]])
    plan = planner(toy, 0).plan(state, toy.generators(3))
    centers = state.centers.unsqueeze(1).repeat(1, plan.predicted_centers.shape[1], 1, 1)
    centers[..., 0] += moves
    known = Prospects(*(torch.tensor([share]) for share in (1.0, failures, 0.0, 0.0)))
    return plan._replace(predicted_centers=centers, prospects=known)


@pytest.mark.parametrize(
    ("risk", "plans", "taken"),
    [
        (0.2, [(0.5, 0.1), (0.1, 0.1), (0.0, 0.1)], 1),  # the first one that is not too risky
        (1.0, [(0.5, 0.1), (0.1, 0.1)], 0),
        (0.05, [(0.5, 0.1), (0.3, 0.1), (0.4, 0.1), (0.2, 0.0)], 1),  # the least risky of those that move something
        (
            0.2,
            [(0.0, 0.0), (0.9, 0.1), (0.1, 0.1)],
            2,
        ),  # what moves something first, then what is safer
        (0.2, [(float("nan"), 0.1), (0.0, 0.1)], 0),  # without perturbed rollouts
    ],
)
def test_a_risky_motion_gives_way_to_one_for_another_effect(
    risk: float, plans: list[tuple[float, float]], taken: int, toy: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    ways = torch.tensor([[0.05, 0.0], [0.0, 0.05], [-0.05, 0.0], [0.0, -0.05]]).view(1, 4, 1, 2)
    monkeypatch.setattr(effect_retries, "first_moves", lambda near, effects: ways)
    effects = SimpleNamespace(returns=torch.tensor([[4.0, 3.0, 2.0, 1.0]]))
    made = [told(toy, *one) for one in plans]
    state, asked = toy.scenes([[(-0.4, 0.0)]]), []

    def motions_for(chosen: Tensor) -> Plan:
        asked.append(int(chosen))
        return made[len(asked) - 1]

    plan = try_other_effects(3, risk, motions_for, torch.tensor([0]), state, effects, state, toy.generators(3))
    assert asked == list(range(len(asked)))  # by return
    assert torch.equal(plan.prospects.failures, made[taken].prospects.failures) or plans[taken][0] != plans[taken][0]
    assert torch.equal(plan.predicted_centers, made[taken].predicted_centers)


def test_numbers_out_of_range_are_refused(toy: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match="effect_retries must be 0 or more, not -1"):
        planner(toy, -1)
    with pytest.raises(ValueError, match="effect_risk must be a share from 0 to 1, not 1.5"):
        planner(toy, 3, effect_risk=1.5)
