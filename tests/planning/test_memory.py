"""What is left of the last plan competes with what is new."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from planning import CavinPlanner, CvaeMpcPlanner, Planner
from planning.candidates import Search
from planning.memory import hints
from planning.optimisers import make_optimiser
from planning.rewards import CumulativeReward


def planner(toy: SimpleNamespace, optimizer: str, **options: object) -> Planner:
    reward = toy.GoalDisc(goal=(0.6, 0.0))
    return CavinPlanner(
        toy.PointMass(), reward, samples=64, horizon=15, optimizer=optimizer, optimizer_options=options or None
    )


def test_the_executed_segment_is_dropped_and_a_fresh_one_follows(toy: SimpleNamespace) -> None:
    state = toy.scenes([[(0.0, 0.0)], [(0.1, 0.0)]])
    last = planner(toy, "evolution").plan(state, toy.generators(1, 2))
    assert last.noise.shape == (2, 5, 16)
    left = hints(last, toy.generators(3, 4))
    assert left is not None and left.shape == (2, 1, 5, 16)
    assert torch.equal(left[:, 0, :-1], last.noise[:, 1:])
    again = hints(last, toy.generators(3, 5))
    assert again is not None
    assert torch.equal(again[0], left[0]) and not torch.equal(again[1], left[1])


def test_the_noise_of_a_plan_gives_its_codes_again(toy: SimpleNamespace) -> None:
    plan = planner(toy, "evolution").plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(1))
    torch.testing.assert_close(plan.noise, plan.effect_codes)  # the toy's prior is N(0, I)


@pytest.mark.parametrize("optimizer", ["shooting", "cem", "smc"])
def test_optimisers_without_a_memory_plan_as_if_nothing_had_been(toy: SimpleNamespace, optimizer: str) -> None:
    state, one = toy.scenes([[(0.0, 0.0)]]), planner(toy, optimizer)
    last = planner(toy, "evolution").plan(state, toy.generators(1))
    anew = one.plan(state, toy.generators(2))
    after = one.plan(state, toy.generators(2), last._replace(noise=last.noise[:, :0]))
    assert torch.equal(anew.actions, after.actions)


def test_what_is_left_is_the_first_candidate_of_evolution(toy: SimpleNamespace) -> None:
    left = torch.randn(1, 1, 3, 2, generator=torch.Generator().manual_seed(0))
    score = CumulativeReward(toy.Hill((0.8, -0.6)))
    search = Search(toy.Placed(), score, toy.scenes([[(0.0, 0.0)]]), toy.generators(0), 3, left)
    for memory in (0.2, 0):
        found = make_optimiser("evolution", {"memory": memory}, samples=32).optimise(search, 32)
        assert torch.equal(found.noise[:, 0], left[:, 0]) is (memory > 0)


def test_a_good_plan_is_not_forgotten(toy: SimpleNamespace) -> None:
    # Too few samples to find the way anew; a plan that knows it, found with many, is followed.
    reward, model = toy.GoalDisc(goal=(0.6, 0.0)), toy.PointMass()
    start = toy.scenes([[(0.0, 0.0)]] * 8)
    many = CavinPlanner(model, reward, samples=2048, horizon=24, optimizer="evolution")
    few = CavinPlanner(model, reward, samples=8, horizon=24, optimizer="evolution")
    last = many.plan(start, toy.generators(*range(8)))
    assert last.expected_success.all()
    then = start._replace(centers=last.subgoals.centers[:, 0])
    anew = few.plan(then, toy.generators(*range(8, 16)))
    remembering = few.plan(then, toy.generators(*range(8, 16)), last)
    assert remembering.expected_success.all() and not anew.expected_success.all()


def test_pushes_are_remembered_too(toy: SimpleNamespace) -> None:
    one = CvaeMpcPlanner(toy.Flat(), toy.GoalDisc(goal=(0.4, 0.0)), samples=32, horizon=9, optimizer="evolution")
    state = toy.scenes([[(0.0, 0.0)]])
    last = one.plan(state, toy.generators(1))
    assert last.noise.shape[1] == 3
    assert not torch.equal(one.plan(state, toy.generators(2)).actions, one.plan(state, toy.generators(2), last).actions)
