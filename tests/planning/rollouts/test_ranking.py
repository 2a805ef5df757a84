"""Choosing among candidates."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from planning.rollouts import ranking

NAN, INF = torch.nan, torch.inf


def test_scores_that_are_not_finite_never_win() -> None:
    scores = torch.tensor([[NAN, -7.0, INF], [-INF, NAN, -1e30], [3.0, 3.0, 1.0]])
    assert ranking.best_of(scores, "scores").tolist() == [1, 2, 0]


def test_nothing_is_chosen_where_no_score_is_finite() -> None:
    with pytest.raises(ValueError, match=r"^environment 1: none of the 2 returns is finite; check .*$"):
        ranking.best_of(torch.tensor([[0.0, 1.0], [NAN, INF]]), "returns")


def test_a_preferred_plan_beats_a_better_score() -> None:
    scores = torch.tensor([[5.0, 1.0, 2.0]]).expand(3, 3)
    preferred = torch.tensor([[False, True, True], [False, True, False], [False, False, False]])
    chosen = ranking.best_of(ranking.prefer(scores, preferred), "scores")
    assert chosen.tolist() == [2, 1, 0]


def test_a_preferred_plan_without_a_finite_score_is_none() -> None:
    scores = ranking.prefer(torch.tensor([[5.0, NAN]]), torch.tensor([[False, True]]))
    assert ranking.best_of(scores, "scores").tolist() == [0]


def test_distance_adds_squares_over_real_objects_and_weighs_features(toy: SimpleNamespace) -> None:
    goal = toy.scenes([[(0.0, 0.0), (1.0, 1.0), (9.0, 9.0)]], gains=(1.0, 1.0, 1.0))
    goal.mask[0, 2] = False
    state = toy.scenes([[(3.0, 4.0), (1.0, 2.0), (NAN, 0.0)]], gains=(1.0, 3.0, NAN))
    assert ranking.squared_distance(state, goal).tolist() == [25.0 + 1.0]
    assert ranking.squared_distance(state, goal, feature_weight=0.5).tolist() == [26.0 + 0.5 * 4.0]


def test_the_running_cost_is_the_mean_over_the_earlier_steps(toy: SimpleNamespace) -> None:
    subgoal = toy.scenes([[(0.0, 0.0), (9.0, 9.0)]])
    subgoal.mask[0, 1] = False
    end = toy.scenes([[(0.0, 1.0), (5.0, 5.0)]])
    path = subgoal.centers.unsqueeze(1).repeat(1, 3, 1, 1)
    path[0, :, 0, 0], path[0, :, 1, 0] = torch.tensor([3.0, 2.0, 7.0]), NAN  # the last of them is not read
    for share in (0.0, 0.25, 1.0):
        distance = ranking.SubgoalDistance(running_cost_share=share)(end, path, subgoal)
        assert distance.tolist() == [(1 - share) * 1.0 + share * (9.0 + 4.0) / 2]
    one_step = ranking.SubgoalDistance(running_cost_share=0.25)(end, path[:, :1], subgoal)
    assert one_step.tolist() == [1.0]
