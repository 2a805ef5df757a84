"""What is left of the last plan competes with what is new."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from planning import CavinPlanner, CvaeMpcPlanner, Plan, Planner
from planning.candidates import Search
from planning.memory import hints
from planning.optimisers import make_optimiser
from planning.rewards import CumulativeReward


def planner(toy: SimpleNamespace, optimizer: str, **options: object) -> Planner:
    reward = toy.GoalDisc(goal=(0.6, 0.0))
    return CavinPlanner(toy.PointMass(), reward, samples=64, horizon=15, optimizer=optimizer, memory=True, **options)


def test_what_is_left_is_the_last_plan_and_the_plan_without_each_of_its_segments(toy: SimpleNamespace) -> None:
    state = toy.scenes([[(0.0, 0.0)], [(0.1, 0.0)]])
    last = planner(toy, "evolution").plan(state, toy.generators(1, 2))
    assert last.noise.shape == (2, 5, 16)
    left = hints(last, toy.generators(3, 4))
    assert left is not None and left.shape == (2, 6, 5, 16)
    assert torch.equal(left[:, 0], last.noise)
    assert torch.equal(left[:, 1, :-1], last.noise[:, 1:])  # all of the first segment was executed
    assert torch.equal(left[:, 3, :-1], last.noise[:, [0, 1, 3, 4]])
    fresh = left[:, 1:, -1]
    assert torch.equal(fresh, fresh[:, :1].expand_as(fresh))
    again = hints(last, toy.generators(3, 5))
    assert again is not None
    assert torch.equal(again[0], left[0]) and not torch.equal(again[1, 1:], left[1, 1:])


def test_the_noise_of_a_plan_gives_its_codes_again(toy: SimpleNamespace) -> None:
    plan = planner(toy, "evolution").plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(1))
    torch.testing.assert_close(plan.noise, plan.effect_codes)  # the toy's prior is N(0, I)


def plans_after(toy: SimpleNamespace, one: Planner) -> tuple[Plan, Plan]:
    """Without and with a last plan, one that is as good as any can be."""
    state = toy.scenes([[(0.0, 0.0)]])
    reward = toy.GoalDisc(goal=(0.6, 0.0))
    good = CavinPlanner(toy.PointMass(), reward, samples=4096, horizon=15, optimizer="evolution", memory=True)
    last = good.plan(state, toy.generators(1))
    assert last.expected_success.all()
    return one.plan(state, toy.generators(2)), one.plan(state, toy.generators(2), last)


@pytest.mark.parametrize("optimizer", ["cem", "smc"])
def test_optimisers_without_a_memory_plan_as_if_nothing_had_been(toy: SimpleNamespace, optimizer: str) -> None:
    state, one = toy.scenes([[(0.0, 0.0)]]), planner(toy, optimizer)
    last = planner(toy, "evolution").plan(state, toy.generators(1))
    anew = one.plan(state, toy.generators(2))
    after = one.plan(state, toy.generators(2), last._replace(noise=last.noise[:, :0]))
    assert torch.equal(anew.actions, after.actions)


@pytest.mark.parametrize("optimizer", ["shooting", "evolution"])
def test_a_planner_without_a_memory_plans_as_if_nothing_had_been(toy: SimpleNamespace, optimizer: str) -> None:
    reward = toy.GoalDisc(goal=(0.6, 0.0))
    anew, after = plans_after(toy, CavinPlanner(toy.PointMass(), reward, samples=64, horizon=15, optimizer=optimizer))
    assert torch.equal(anew.effect_codes, after.effect_codes)


@pytest.mark.parametrize("optimizer", ["shooting", "evolution"])
def test_a_planner_with_a_memory_does_no_worse_than_its_last_plan(toy: SimpleNamespace, optimizer: str) -> None:
    _, after = plans_after(toy, planner(toy, optimizer))
    assert after.expected_success.all()


def test_what_is_left_takes_the_last_places(toy: SimpleNamespace) -> None:
    left = torch.randn(1, 4, 3, 2, generator=torch.Generator().manual_seed(0))
    score = CumulativeReward(toy.Hill((0.8, -0.6)))
    search = Search(toy.Placed(), score, toy.scenes([[(0.0, 0.0)]]), toy.generators(0), 3, True, left)
    shot = make_optimiser("shooting", None, samples=32).optimise(search, 32)
    assert torch.equal(shot.noise[:, -4:], left)
    assert torch.equal(make_optimiser("shooting", None, samples=3).optimise(search, 3).noise, left[:, :3])
    for memory in (0.25, 0):
        found = make_optimiser("evolution", {"memory": memory}, samples=32).optimise(search, 32)
        assert torch.equal(found.noise[:, 12:16], left) is (memory > 0)  # of the first generation's 16


@pytest.mark.parametrize("optimizer", ["shooting", "evolution"])
def test_where_nothing_reaches_the_goal_a_new_plan_is_made_not_the_old_one_again(
    toy: SimpleNamespace, optimizer: str
) -> None:
    # All plans are worth the same under a sparse reward whose goal is out of reach.
    reward = toy.GoalDisc(goal=(50.0, 0.0))
    one = CavinPlanner(toy.PointMass(), reward, samples=64, horizon=15, optimizer=optimizer, memory=True)
    state = toy.scenes([[(0.0, 0.0)]])
    last = one.plan(state, toy.generators(1))
    next_one = one.plan(state, toy.generators(2), last)
    assert not last.expected_success.any() and not next_one.expected_success.any()
    assert not torch.equal(next_one.effect_codes[:, 0], last.effect_codes[:, 0])


def test_a_plan_that_succeeds_loses_what_it_does_not_need(toy: SimpleNamespace) -> None:
    # First away from the goal; with 16 samples no better plan is found at random.
    one = CavinPlanner(toy.PointMass(), toy.GoalDisc(goal=(0.6, 0.0)), samples=16, horizon=18, memory=True)
    state = toy.scenes([[(0.0, 0.0)]])
    detour = torch.zeros(1, 6, 16)
    detour[..., 0] = torch.tensor([-5.0, 5.0, 5.0, 5.0, 5.0, 5.0])  # 15 cm each
    plan = one.plan(state, toy.generators(2), one.plan(state, toy.generators(1))._replace(noise=detour))
    assert plan.expected_success.all() and plan.segments.tolist() == [4]
    assert torch.equal(plan.effect_codes[:, :4], detour[:, 1:5])


def test_a_good_plan_is_not_forgotten(toy: SimpleNamespace) -> None:
    # Too few samples to find the way anew; a plan that knows it, found with many, is followed.
    reward, model = toy.GoalDisc(goal=(0.6, 0.0)), toy.PointMass()
    start = toy.scenes([[(0.0, 0.0)]] * 8)
    many = CavinPlanner(model, reward, samples=2048, horizon=24, optimizer="evolution", memory=True)
    few = CavinPlanner(model, reward, samples=32, horizon=24, optimizer="evolution", memory=True)
    last = many.plan(start, toy.generators(*range(8)))
    assert last.expected_success.all()
    then = start._replace(centers=last.subgoals.centers[:, 0])
    anew = few.plan(then, toy.generators(*range(8, 16)))
    remembering = few.plan(then, toy.generators(*range(8, 16)), last)
    assert remembering.expected_success.all() and not anew.expected_success.all()


def test_pushes_are_remembered_too(toy: SimpleNamespace) -> None:
    one = CvaeMpcPlanner(
        toy.Flat(), toy.GoalDisc(goal=(0.4, 0.0)), samples=32, horizon=9, optimizer="evolution", memory=True
    )
    state = toy.scenes([[(0.0, 0.0)]])
    last = one.plan(state, toy.generators(1))
    assert last.noise.shape[1] == 3
    assert not torch.equal(one.plan(state, toy.generators(2)).actions, one.plan(state, toy.generators(2), last).actions)
