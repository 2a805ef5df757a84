"""Interpolation and cumulative reward."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from planning.protocol import Outcome
from planning.rollouts import returns

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


def test_interpolation_works_over_any_leading_dimensions() -> None:
    first, last = torch.randn(2, 1, 4, 3), torch.randn(2, 5, 4, 3)
    path = returns.interpolate(first, last, 3)
    assert path.shape == (2, 5, 3, 4, 3)
    torch.testing.assert_close(path[1, 4], returns.interpolate(first[1, 0], last[1, 4], 3))


def walk(toy: SimpleNamespace, *positions: float) -> torch.Tensor:
    """States [T, M = 1, 3] of one object on a line."""
    return torch.tensor([[[x, 0.0, 0.0]] for x in positions])


def advance(toy: SimpleNamespace, *segments: torch.Tensor, mask: bool = True) -> returns.Progress:
    before = torch.zeros(1, 3)
    progress = returns.start(before)
    for path in segments:
        progress = returns.advance(progress, toy.Line(), before, path, torch.tensor([mask]))
        before = path[-1]
    return progress


def test_every_step_of_an_active_plan_counts(toy: SimpleNamespace) -> None:
    progress = advance(toy, walk(toy, 0.1, 0.2, 0.3), walk(toy, 0.4, 0.5, 0.6))
    assert progress.returns == -6.0
    assert progress.active
    assert progress.segments == 2


def test_rewards_after_a_success_do_not_count(toy: SimpleNamespace) -> None:
    ended = advance(toy, walk(toy, 0.5, 1.0, 1.5), walk(toy, -1.0, -1.0, -1.0))
    assert ended.returns == -1.0 + 99.0
    assert ended.succeeded
    assert not ended.failed
    assert ended.segments == 1


def test_rewards_after_a_failure_do_not_count(toy: SimpleNamespace) -> None:
    ended = advance(toy, walk(toy, -0.2, -0.4, -0.6), walk(toy, 1.0, 1.0, 1.0))
    assert ended.returns == -2.0 - 101.0
    assert ended.failed
    assert not ended.succeeded
    assert ended.segments == 1


def test_a_step_that_succeeds_and_fails_is_a_failure(toy: SimpleNamespace) -> None:
    def contradictory(previous: torch.Tensor, centers: torch.Tensor, mask: torch.Tensor) -> Outcome:
        both = torch.ones(centers.shape[:-2], dtype=torch.bool)
        return toy.StepOutcome(torch.zeros(both.shape), both, both)

    path = walk(toy, 0.0)
    ended = returns.advance(returns.start(path[0]), contradictory, path[0], path, torch.ones(1, dtype=torch.bool))
    assert ended.failed
    assert not ended.succeeded


def test_the_reward_sees_each_step_with_the_state_before_it(toy: SimpleNamespace) -> None:
    def distance_moved(previous: torch.Tensor, centers: torch.Tensor, mask: torch.Tensor) -> Outcome:
        moved = (centers - previous)[..., 0, 0]
        seen.append(moved)
        never = torch.zeros(moved.shape, dtype=torch.bool)
        return toy.StepOutcome(moved, never, never)

    seen: list[torch.Tensor] = []
    path = walk(toy, 0.5, 0.75, 2.0)
    mask = torch.ones(1, dtype=torch.bool)
    progress = returns.advance(returns.start(path[0]), distance_moved, torch.zeros(1, 3), path, mask)
    assert seen[0].tolist() == [0.5, 0.25, 1.25]
    assert progress.returns == 2.0


def test_a_reward_that_judges_whole_paths_is_asked_once_for_each(toy: SimpleNamespace) -> None:
    asked = []

    class Whole(toy.Line):
        def along(self, states: torch.Tensor, mask: torch.Tensor) -> Outcome:
            asked.append(states.shape)
            return self(states[..., :-1, :, :], states[..., 1:, :, :], mask.unsqueeze(-2).expand(5, 3, 1))

    before, path, mask = torch.zeros(5, 1, 3), torch.randn(5, 3, 1, 3), torch.ones(5, 1, dtype=torch.bool)
    found = returns.advance(returns.start(before), Whole(), before, path, mask)
    assert asked == [(5, 4, 1, 3)]
    for ours, theirs in zip(found, returns.advance(returns.start(before), toy.Line(), before, path, mask), strict=True):
        assert torch.equal(ours, theirs)


def test_a_plan_that_leaves_the_numbers_fails_whatever_the_reward_says(toy: SimpleNamespace) -> None:
    def cheerful(previous: torch.Tensor, centers: torch.Tensor, mask: torch.Tensor) -> Outcome:
        always = torch.ones(centers.shape[:-2], dtype=torch.bool)
        return toy.StepOutcome(torch.full(always.shape, 99.0), always, ~always)

    def endless(previous: torch.Tensor, centers: torch.Tensor, mask: torch.Tensor) -> Outcome:
        never = torch.zeros(centers.shape[:-2], dtype=torch.bool)
        return toy.StepOutcome(torch.full(never.shape, torch.inf), never, never)

    mask = torch.ones(1, dtype=torch.bool)
    for reward, position in ((cheerful, torch.nan), (cheerful, torch.inf), (endless, 0.0)):
        path = walk(toy, position)
        lost = returns.advance(returns.start(path[0]), reward, torch.zeros(1, 3), path, mask)
        assert lost.returns == -torch.inf
        assert lost.failed
        assert not lost.succeeded


def test_padding_may_hold_anything(toy: SimpleNamespace) -> None:
    path = torch.stack([torch.tensor([[0.1, 0.0, 0.0], [torch.nan] * 3])] * 2)
    mask = torch.tensor([True, False])
    progress = returns.advance(returns.start(path[0]), toy.Line(), path[0], path, mask)
    assert progress.returns == -2.0
    assert progress.active
