"""Stride limits, and where rewards are taken."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from planning.rollouts.cumulative_reward import CumulativeReward, StrideLimits
from planning.rollouts.returns import advance, start


def way(*x: float, objects: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """States before and after T steps of objects of which the first goes along x and the others stay."""
    centers = torch.zeros(len(x), objects, 3)
    centers[:, 0, 0] = torch.tensor(x)
    return centers[:-1], centers[1:], torch.ones(len(x) - 1, objects, dtype=torch.bool)


@pytest.mark.parametrize(
    ("x", "failures"),
    [
        ((0.0, 0.1, 0.2, 0.3), [False, False, False]),
        ((0.0, 0.01, 0.02, 0.03), [True, False, False]),  # all objects less than 0.1 m
        ((0.0, 0.2, 0.4, 0.6), [True, False, False]),  # an object more than 0.5 m
        ((0.0, 0.4, 0.8, 0.2), [False, False, False]),  # only the ends of the segment matter
    ],
)
def test_strides_of_segments(toy: SimpleNamespace, x: tuple[float, ...], failures: list[bool]) -> None:
    limited = StrideLimits(toy.Hill((0.0, 0.0)), [0.1, 0.5], of="segments")
    outcome = limited(*way(*x))
    assert outcome.failure.tolist() == failures
    assert (outcome.reward[outcome.failure] == -100.0).all()
    assert torch.equal(outcome.reward[1:], toy.Hill((0.0, 0.0))(*way(*x)).reward[1:])


def test_strides_of_pushes(toy: SimpleNamespace) -> None:
    limited = StrideLimits(toy.Hill((0.0, 0.0)), [0.01, 0.15], of="pushes")
    assert limited(*way(0.0, 0.005, 0.105, 0.305)).failure.tolist() == [True, False, True]


def test_one_object_that_moves_is_enough_and_one_that_flies_too_much(toy: SimpleNamespace) -> None:
    limited = StrideLimits(toy.Hill((0.0, 0.0)), [0.1, 0.5], of="segments")
    assert not limited(*way(0.0, 0.1, 0.2, 0.3, objects=3)).failure.any()
    assert limited(*way(0.0, 0.3, 0.6, 0.9, objects=3)).failure.any()
    previous, centers, mask = way(0.0, 0.3, 0.6, 0.9, objects=2)
    mask[:, 0] = False  # padding flies, what is real stays: too short a stride
    assert limited(previous, centers, mask).failure.any()


def test_no_success_outside_the_limits(toy: SimpleNamespace) -> None:
    reward = toy.GoalDisc(goal=(0.9, 0.0))
    plain, limited = (
        advance(start(before[:1][0]), judge, before[:1][0], after, mask[0])
        for judge in (reward, StrideLimits(reward, [0.1, 0.5], of="segments"))
        for before, after, mask in [way(0.0, 0.3, 0.6, 0.9)]
    )
    assert plain.succeeded
    assert limited.failed
    assert not limited.succeeded
    assert limited.returns == -100.0


@pytest.mark.parametrize("limits", [[0.3], [0.3, 0.1], [-0.1, 0.3], 3, ["a", "b"]])
def test_bad_limits_are_one_clear_line(toy: SimpleNamespace, limits: object) -> None:
    with pytest.raises(ValueError, match="^stride_limits must be two distances in metres, low then high, not "):
        StrideLimits(toy.Line(), limits, of="segments")  # type: ignore[arg-type]


def test_an_unknown_place_of_reward_is_one_clear_line(toy: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match="^unknown reward_at 'goal': choose path or subgoals$"):
        CumulativeReward(toy.Line(), "goal")


def test_limits_take_away_from_what_can_be_earned_and_add_nothing(toy: SimpleNamespace) -> None:
    sparse, dense = (toy.GoalDisc(goal=(0.0, 0.0), dense=dense) for dense in (False, True))
    assert StrideLimits(sparse, (0.1, 0.3), of="segments").maximum_return == sparse.maximum_return == 99.0
    assert StrideLimits(dense, (0.1, 0.3), of="segments").maximum_return == float("inf")
    assert StrideLimits(toy.Hill((0.0, 0.0)), (0.1, 0.3), of="segments").maximum_return == float(
        "inf"
    )  # it does not say
