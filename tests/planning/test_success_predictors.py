"""What a plan tells about its chances, on a point mass that obeys."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from planning import CavinPlanner, CvaeMpcPlanner, PerturbedRollouts, RandomPlanner
from planning.plan import SuccessPredictors
from tests.planning.extensions.test_guidance import guided_disc


def success_predictors(
    planner: CavinPlanner | CvaeMpcPlanner, toy: SimpleNamespace, *starts: tuple[float, float]
) -> SuccessPredictors:
    plan = planner.plan(toy.scenes([[start] for start in starts]), toy.generators(*range(len(starts))))
    assert plan.success_predictors is not None
    return plan.success_predictors


def test_the_share_of_candidates_that_reach_the_goal_is_that_of_their_returns(toy: SimpleNamespace) -> None:
    planner = toy.plain(toy.PointMass(), toy.GoalDisc(goal=(0.2, 0.0), radius=0.05), samples=512, horizon=6)
    plan = planner.plan(toy.scenes([[(0.0, 0.0)], [(9.0, 0.0)]]), toy.generators(0, 1))
    assert plan.success_predictors is not None
    assert plan.success_predictors.reaching.tolist() == (plan.candidate_returns > 0).float().mean(-1).tolist()
    assert plan.success_predictors.reaching[0] > 0.0 == plan.success_predictors.reaching[1]


def test_failures_are_those_of_the_chosen_motion(toy: SimpleNamespace) -> None:
    starts, reward = ((0.0, 0.3), (0.0, 0.004)), toy.GoalDisc(goal=(0.1, 0.3), radius=0.05, forbidden_below=0.0)
    options = {"samples": 64, "horizon": 6, "warm_start": False}
    robust = PerturbedRollouts(candidates=16, start_noise=0.0, outcome_noise=1.0)
    for planner in (
        CavinPlanner(toy.PointMass(), reward, robustness=robust, **options),
        CvaeMpcPlanner(toy.Flat(), reward, robustness=robust, **options),
    ):
        safe, risky = success_predictors(planner, toy, *starts).failures.tolist()
        assert 0.0 == safe < risky <= 1.0
    without = CavinPlanner(toy.PointMass(), reward, robustness=None, **options)
    assert success_predictors(without, toy, *starts).failures.isnan().all()


def test_the_way_is_told_with_guidance_alone(toy: SimpleNamespace) -> None:
    reward = guided_disc(toy, goal=(2.0, 0.0))
    for guidance in ("none", "layout"):
        told = success_predictors(
            toy.plain(toy.PointMass(), reward, 256, 6, guidance=guidance), toy, (0.0, 0.0), (0.5, 0.0)
        )
        if guidance == "none":
            assert told.distance_to_goal.isnan().all() and told.distance_to_goal_after.isnan().all()
        else:
            assert told.distance_to_goal[0] - told.distance_to_goal[1] == pytest.approx(0.5)
            assert (
                (told.distance_to_goal_after < told.distance_to_goal - 0.1) & (told.distance_to_goal_after > 0.0)
            ).all()


def test_planners_that_predict_nothing_tell_nothing(toy: SimpleNamespace) -> None:
    plan = RandomPlanner().plan(toy.scenes([[(0.0, 0.0)]]), [torch.Generator().manual_seed(0)])
    assert plan.success_predictors is None
