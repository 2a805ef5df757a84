"""Returns, where rewards are taken, and the choice among candidates."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cavin_pyro.planning import RewardFunction, StepOutcome, returns
from cavin_pyro.planning.protocol import as_reward

POSITIONS = st.floats(-2.0, 2.0, width=32)


@settings(deadline=None, max_examples=50)
@given(
    start=st.lists(POSITIONS, min_size=6, max_size=6),
    end=st.lists(POSITIONS, min_size=6, max_size=6),
    steps=st.integers(1, 7),
)
def test_interpolation_is_linear_and_hits_the_subgoal(start: list, end: list, steps: int) -> None:
    first, last = torch.tensor(start).view(2, 3), torch.tensor(end).view(2, 3)
    path = returns.interpolate(first, last, steps)
    assert path.shape == (steps, 2, 3)
    assert torch.equal(path[-1], last)
    moves = torch.diff(torch.cat([first[None], path]), dim=0)
    torch.testing.assert_close(moves, ((last - first) / steps).expand_as(moves), rtol=0, atol=2e-6)


def advance(reward: RewardFunction, *segments: list[float]) -> returns.Progress:
    """Progress of one object that goes along x, segment by segment."""
    before = torch.zeros(1, 3)
    progress = returns.start(before)
    for positions in segments:
        path = torch.tensor([[[x, 0.0, 0.0]] for x in positions])
        progress = returns.advance(progress, as_reward(reward), before, path, torch.tensor([True]))
        before = path[-1]
    return progress


def test_every_step_of_an_active_plan_counts(toy: SimpleNamespace) -> None:
    progress = advance(toy.Line(), [0.1, 0.2, 0.3], [0.4, 0.5, 0.6])
    assert progress.returns == -6.0
    assert progress.active
    assert progress.segments == 2


def test_rewards_after_the_end_do_not_count(toy: SimpleNamespace) -> None:
    won = advance(toy.Line(), [0.5, 1.0, 1.5], [-1.0, -1.0, -1.0])
    assert (won.returns, won.succeeded, won.failed, won.segments) == (-1.0 + 99.0, True, False, 1)
    lost = advance(toy.Line(), [-0.2, -0.4, -0.6], [1.0, 1.0, 1.0])
    assert (lost.returns, lost.succeeded, lost.failed, lost.segments) == (-2.0 - 101.0, False, True, 1)


def test_a_step_that_succeeds_and_fails_is_a_failure(toy: SimpleNamespace) -> None:
    both = torch.ones(1, dtype=torch.bool)
    ended = advance(lambda *_: toy.StepOutcome(torch.zeros(1), both, both), [0.0])
    assert ended.failed and not ended.succeeded


def test_the_reward_sees_each_step_with_the_state_before_it(toy: SimpleNamespace) -> None:
    def distance_moved(previous: torch.Tensor, centers: torch.Tensor, mask: torch.Tensor) -> StepOutcome:
        moved = (centers - previous)[..., 0, 0]
        seen.append(moved)
        never = torch.zeros(moved.shape, dtype=torch.bool)
        return toy.StepOutcome(moved, never, never)

    seen: list[torch.Tensor] = []
    progress = advance(distance_moved, [0.5, 0.75, 2.0])
    assert seen[0].tolist() == [0.5, 0.25, 1.25]
    assert progress.returns == 2.0


def test_a_plan_that_leaves_the_numbers_fails_whatever_the_reward_says(toy: SimpleNamespace) -> None:
    def cheerful(previous: torch.Tensor, centers: torch.Tensor, mask: torch.Tensor) -> StepOutcome:
        always = torch.ones(centers.shape[:-2], dtype=torch.bool)
        return toy.StepOutcome(torch.full(always.shape, 99.0), always, ~always)

    def endless(previous: torch.Tensor, centers: torch.Tensor, mask: torch.Tensor) -> StepOutcome:
        never = torch.zeros(centers.shape[:-2], dtype=torch.bool)
        return toy.StepOutcome(torch.full(never.shape, torch.inf), never, never)

    for reward, position in ((cheerful, torch.nan), (cheerful, torch.inf), (endless, 0.0)):
        lost = advance(reward, [position])
        assert lost.returns == -torch.inf
        assert lost.failed
        assert not lost.succeeded


NAN, INF = torch.nan, torch.inf


def test_scores_that_are_not_finite_never_win() -> None:
    scores = torch.tensor([[NAN, -7.0, INF], [-INF, NAN, -1e30], [3.0, 3.0, 1.0]])
    assert returns.best_of(scores, "scores").tolist() == [1, 2, 0]


def test_nothing_is_chosen_where_no_score_is_finite() -> None:
    with pytest.raises(ValueError, match=r"^environment 1: none of the 2 returns is finite; check .*$"):
        returns.best_of(torch.tensor([[0.0, 1.0], [NAN, INF]]), "returns")


def test_a_preferred_plan_beats_a_better_score() -> None:
    scores = torch.tensor([[5.0, 1.0, 2.0]]).expand(3, 3)
    preferred = torch.tensor([[False, True, True], [False, True, False], [False, False, False]])
    chosen = returns.best_of(returns.prefer(scores, preferred), "scores")
    assert chosen.tolist() == [2, 1, 0]


def test_distance_adds_squares_over_real_objects_and_weighs_features(toy: SimpleNamespace) -> None:
    goal = toy.scenes([[(0.0, 0.0), (1.0, 1.0), (9.0, 9.0)]], gains=(1.0, 1.0, 1.0))
    goal.mask[0, 2] = False
    state = toy.scenes([[(3.0, 4.0), (1.0, 2.0), (NAN, 0.0)]], gains=(1.0, 3.0, NAN))
    assert returns.squared_distance(state, goal).tolist() == [25.0 + 1.0]
    assert returns.squared_distance(state, goal, feature_weight=0.5).tolist() == [26.0 + 0.5 * 4.0]


def test_a_segment_is_compared_at_its_end_or_after_its_first_push(toy: SimpleNamespace) -> None:
    subgoal = toy.scenes([[(0.0, 0.0), (9.0, 9.0)]])
    subgoal.mask[0, 1] = False
    end = toy.scenes([[(0.0, 1.0), (5.0, 5.0)]])._replace(features=subgoal.features + 1.0)
    path = subgoal.centers.unsqueeze(1).repeat(1, 3, 1, 1)
    path[0, :, 0, 0], path[0, :, 1, 0] = torch.tensor([3.0, NAN, NAN]), NAN  # only the first is read, of real objects
    assert returns.SubgoalDistance()(end, path, subgoal).tolist() == [1.0]
    assert returns.SubgoalDistance(at="first_push")(end, path, subgoal).tolist() == [9.0]
    assert returns.SubgoalDistance(2.0, "first_push")(end, path, subgoal).tolist() == [9.0 + 2.0]
