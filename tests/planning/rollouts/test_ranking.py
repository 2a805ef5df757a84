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


def test_a_segment_is_compared_at_its_end_or_after_its_first_push(toy: SimpleNamespace) -> None:
    subgoal = toy.scenes([[(0.0, 0.0), (9.0, 9.0)]])
    subgoal.mask[0, 1] = False
    end = toy.scenes([[(0.0, 1.0), (5.0, 5.0)]])._replace(features=subgoal.features + 1.0)
    path = subgoal.centers.unsqueeze(1).repeat(1, 3, 1, 1)
    path[0, :, 0, 0], path[0, :, 1, 0] = torch.tensor([3.0, NAN, NAN]), NAN  # only the first is read, of real objects
    assert ranking.SubgoalDistance()(end, path, subgoal).tolist() == [1.0]
    assert ranking.SubgoalDistance(at="first_push")(end, path, subgoal).tolist() == [9.0]
    assert ranking.SubgoalDistance(2.0, "first_push")(end, path, subgoal).tolist() == [9.0 + 2.0]
