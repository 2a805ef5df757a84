"""A warm start: the last plan competes with new candidates."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from planning import CvaeMpcPlanner, Plan, Planner
from planning.extensions.warm_start import warm_start_noise
from planning.optimizers import OPTIMIZERS, Evolution, Shooting, make_optimizer, search
from planning.rollouts.candidates import SearchProblem
from planning.rollouts.cumulative_reward import CumulativeReward


def planner(toy: SimpleNamespace, optimizer: str, **options: object) -> Planner:
    reward = toy.GoalDisc(goal=(0.6, 0.0))
    return toy.plain(toy.PointMass(), reward, samples=64, horizon=15, optimizer=optimizer, warm_start=True, **options)


def test_the_warm_start_is_the_last_plan_and_the_plan_without_each_of_its_segments(toy: SimpleNamespace) -> None:
    state = toy.scenes([[(0.0, 0.0)], [(0.1, 0.0)]])
    last = planner(toy, "evolution").plan(state, toy.generators(1, 2))
    assert last.noise.shape == (2, 5, 16)
    left = warm_start_noise(last, toy.generators(3, 4))
    assert left is not None and left.shape == (2, 6, 5, 16)
    assert torch.equal(left[:, 0], last.noise)
    assert torch.equal(left[:, 1, :-1], last.noise[:, 1:])  # all of the first segment was executed
    assert torch.equal(left[:, 3, :-1], last.noise[:, [0, 1, 3, 4]])
    fresh = left[:, 1:, -1]
    assert torch.equal(fresh, fresh[:, :1].expand_as(fresh))
    again = warm_start_noise(last, toy.generators(3, 5))
    assert again is not None
    assert torch.equal(again[0], left[0]) and not torch.equal(again[1, 1:], left[1, 1:])


def test_the_noise_of_a_plan_gives_its_codes_again(toy: SimpleNamespace) -> None:
    plan = planner(toy, "evolution").plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(1))
    torch.testing.assert_close(plan.noise, plan.effect_codes)  # the toy's prior is N(0, I)


def plans_after(toy: SimpleNamespace, one: Planner) -> tuple[Plan, Plan]:
    """Without and with a last plan, one that is as good as any can be."""
    state = toy.scenes([[(0.0, 0.0)]])
    reward = toy.GoalDisc(goal=(0.6, 0.0))
    good = toy.plain(toy.PointMass(), reward, samples=4096, horizon=15, optimizer="evolution", warm_start=True)
    last = good.plan(state, toy.generators(1))
    assert last.expected_success.all()
    return one.plan(state, toy.generators(2)), one.plan(state, toy.generators(2), last)


@pytest.mark.parametrize("optimizer", sorted(OPTIMIZERS))
def test_only_shooting_and_evolution_read_the_warm_start(toy: SimpleNamespace, optimizer: str) -> None:
    warm = torch.randn(1, 4, 3, 2, generator=torch.Generator().manual_seed(0))
    returns = []
    for known in (None, warm):
        objective, state = CumulativeReward(toy.Hill((0.8, -0.6))), toy.scenes([[(0.0, 0.0)]])
        problem = SearchProblem(toy.Placed(), objective, state, toy.generators(0), 3, True, known)
        returns.append(search(make_optimizer(optimizer, samples=32), problem, 32).returns)
    assert torch.equal(*returns) is (optimizer not in ("shooting", "evolution"))


@pytest.mark.parametrize("optimizer", ["shooting", "evolution"])
def test_a_planner_without_a_warm_start_ignores_the_last_plan(toy: SimpleNamespace, optimizer: str) -> None:
    reward = toy.GoalDisc(goal=(0.6, 0.0))
    anew, after = plans_after(toy, toy.plain(toy.PointMass(), reward, samples=64, horizon=15, optimizer=optimizer))
    assert torch.equal(anew.effect_codes, after.effect_codes)


@pytest.mark.parametrize("optimizer", ["shooting", "evolution"])
def test_a_planner_with_a_warm_start_does_no_worse_than_its_last_plan(toy: SimpleNamespace, optimizer: str) -> None:
    _, after = plans_after(toy, planner(toy, optimizer))
    assert after.expected_success.all()


def test_the_warm_start_takes_the_last_places(toy: SimpleNamespace) -> None:
    left = torch.randn(1, 4, 3, 2, generator=torch.Generator().manual_seed(0))
    objective = CumulativeReward(toy.Hill((0.8, -0.6)))
    problem = SearchProblem(toy.Placed(), objective, toy.scenes([[(0.0, 0.0)]]), toy.generators(0), 3, True, left)
    assert torch.equal(search(Shooting(), problem, 32).noise[:, -4:], left)
    assert torch.equal(search(Shooting(), problem, 3).noise, left[:, :3])
    for fraction in (0.25, 0):
        found = search(Evolution(warm_start=fraction), problem, 32)
        assert torch.equal(found.noise[:, 12:16], left) is (fraction > 0)  # of the initial generation's 16


@pytest.mark.parametrize("optimizer", ["shooting", "evolution"])
def test_where_nothing_reaches_the_goal_a_new_plan_is_made_not_the_old_one_again(
    toy: SimpleNamespace, optimizer: str
) -> None:
    # All plans are worth the same under a sparse reward whose goal is out of reach.
    reward = toy.GoalDisc(goal=(50.0, 0.0))
    one = toy.plain(toy.PointMass(), reward, samples=64, horizon=15, optimizer=optimizer, warm_start=True)
    state = toy.scenes([[(0.0, 0.0)]])
    last = one.plan(state, toy.generators(1))
    next_one = one.plan(state, toy.generators(2), last)
    assert not last.expected_success.any() and not next_one.expected_success.any()
    assert not torch.equal(next_one.effect_codes[:, 0], last.effect_codes[:, 0])


def test_a_plan_that_succeeds_loses_what_it_does_not_need(toy: SimpleNamespace) -> None:
    # First away from the goal; with 16 samples no better plan is found at random.
    one = toy.plain(toy.PointMass(), toy.GoalDisc(goal=(0.6, 0.0)), samples=16, horizon=18, warm_start=True)
    state = toy.scenes([[(0.0, 0.0)]])
    detour = torch.zeros(1, 6, 16)
    detour[..., 0] = torch.tensor([-5.0, 5.0, 5.0, 5.0, 5.0, 5.0])  # 15 cm each
    plan = one.plan(state, toy.generators(2), one.plan(state, toy.generators(1))._replace(noise=detour))
    assert plan.expected_success.all() and plan.segments.tolist() == [4]
    assert torch.equal(plan.effect_codes[:, :4], detour[:, 1:5])


def test_a_good_plan_is_kept(toy: SimpleNamespace) -> None:
    # Too few samples to find the way anew; a plan that knows it, found with many, is followed.
    reward, model = toy.GoalDisc(goal=(0.6, 0.0)), toy.PointMass()
    start = toy.scenes([[(0.0, 0.0)]] * 8)
    many = toy.plain(model, reward, samples=2048, horizon=24, optimizer="evolution", warm_start=True)
    few = toy.plain(model, reward, samples=32, horizon=24, optimizer="evolution", warm_start=True)
    last = many.plan(start, toy.generators(*range(8)))
    assert last.expected_success.all()
    then = start._replace(centers=last.subgoals.centers[:, 0])
    anew = few.plan(then, toy.generators(*range(8, 16)))
    warm = few.plan(then, toy.generators(*range(8, 16)), last)
    assert warm.expected_success.all() and not anew.expected_success.all()


def test_pushes_have_a_warm_start_too(toy: SimpleNamespace) -> None:
    one = CvaeMpcPlanner(
        toy.Flat(), toy.GoalDisc(goal=(0.4, 0.0)), samples=32, horizon=9, optimizer="evolution", warm_start=True
    )
    state = toy.scenes([[(0.0, 0.0)]])
    last = one.plan(state, toy.generators(1))
    assert last.noise.shape[1] == 3
    assert not torch.equal(one.plan(state, toy.generators(2)).actions, one.plan(state, toy.generators(2), last).actions)
