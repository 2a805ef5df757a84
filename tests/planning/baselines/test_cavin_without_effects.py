"""The cascade's codes together, and CAVIN with fewer motions: the links between CAVIN and its baselines."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from models.state import State
from planning import CavinWithoutEffectsPlanner
from planning.optimizers import Evolution

OFF = {"warm_start": False, "robustness": None, "idle_distance": 0.0}


def test_codes_are_sampled_as_the_cascade_generates_them(toy: SimpleNamespace) -> None:
    # Two segments of three samples: a row of each table per segment, and T = 2 pushes by c / 2 + z.
    effects, motions = [[-0.5, 0.5, -2.0], [0.25, 0.5, 0.0]], [[0.0, 0.125, 0.0], [0.0, 0.25, 0.0]]
    planner = CavinWithoutEffectsPlanner(toy.Tabled(effects, motions), toy.Line(), samples=3, horizon=4, **OFF)
    plan = planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(0))
    # The second one goes to 0.75, where a copy of it takes the first one's place, and succeeds with its third push.
    assert plan.candidate_returns[0, 1] == -2.0 + 99.0 == plan.expected_return
    assert plan.motion_codes[0, :, [0, 16]].tolist() == [[0.5, 0.125], [0.5, 0.25]]
    assert plan.planned_actions[0, :, 2].tolist() == [0.375, 0.375, 0.5, 0.5]
    assert plan.predicted_centers[0, :2, 0, 0].tolist() == [0.375, 0.75]
    assert plan.motion_codes.shape == (1, 2, 32) and plan.effect_codes.shape == (1, 0, 0)
    assert plan.subgoals.centers.shape == (1, 0, 1, 3)


def test_the_noise_of_a_plan_is_that_of_both_codes(toy: SimpleNamespace) -> None:
    planner = CavinWithoutEffectsPlanner(toy.PointMass(), toy.GoalDisc((0.3, 0.0)), samples=64, horizon=9)
    plan = planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(1))
    assert plan.noise.shape == (1, 3, 32)
    torch.testing.assert_close(plan.noise, plan.motion_codes)  # the toy's priors are N(0, I)


def test_h_is_not_asked(toy: SimpleNamespace) -> None:
    class WithoutSubgoals(toy.PointMass):  # type: ignore[name-defined]
        def subgoal(self, state: State, effect_code: Tensor) -> State:
            raise AssertionError

    planner = CavinWithoutEffectsPlanner(WithoutSubgoals(), toy.GoalDisc((0.2, 0.0)), samples=64, horizon=6)
    assert planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(1)).actions.isfinite().all()


@pytest.mark.parametrize("horizon", ["full_horizon", "first_segment"])
def test_one_motion_is_the_one_that_is_drawn(horizon: str, toy: SimpleNamespace) -> None:
    asked = []

    class Counting(toy.PointMass):  # type: ignore[name-defined]
        def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
            asked.append(motion_code)
            return super().actions(state, effect_code, motion_code)

    state, reward = toy.scenes([[(0.0, 0.0)]]), toy.GoalDisc((0.3, 0.0))
    planner = toy.plain(Counting(), reward, samples=64, horizon=6, motion_horizon=horizon, motion_samples=1)
    plan = planner.plan(state, toy.generators(1))
    assert [code.shape for code in asked] == [(1, 1, 16)] * (2 if horizon == "full_horizon" else 1)
    assert torch.equal(plan.motion_codes[:, :1], asked[0])
    many = toy.plain(toy.PointMass(), reward, samples=64, horizon=6, motion_horizon=horizon).plan(
        state, toy.generators(1)
    )
    assert torch.equal(plan.effect_codes, many.effect_codes)


def test_motion_samples_are_checked(toy: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match="^motion_samples must be at least 1, not 0$"):
        toy.plain(toy.PointMass(), toy.GoalDisc((0.3, 0.0)), motion_samples=0)
    with pytest.raises(ValueError, match="iterations need at least as many samples, not 1"):
        toy.plain(toy.PointMass(), toy.GoalDisc((0.3, 0.0)), motion_samples=1, motion_optimizer=Evolution())
