"""Pushes that move nothing are left for later."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from models.state import State
from planning.extensions.idle_pushes import idle_last
from planning.extensions.touchdown import ObservedPoints


def motions(*strides: float) -> tuple[Tensor, Tensor, State]:
    """Pushes numbered from 0, of which each moves the second of two objects; the third is padding, and wanders."""
    count = len(strides)
    start = torch.tensor([[[0.0, 0.0, 0.0], [0.3, 0.1, 0.0], [9.0, 9.0, 9.0]]])
    path = start.repeat(count, 1, 1)
    path[:, 1, 0] += torch.tensor(strides).cumsum(0)
    path[:, 2] += torch.arange(count).unsqueeze(-1)
    pushes = torch.arange(count, dtype=torch.float32).view(1, count, 1).expand(-1, -1, 4)
    state = State(start, torch.zeros(1, 3, 2), torch.tensor([[True, True, False]]))
    return pushes, path.unsqueeze(0), state


def order(actions: Tensor) -> list[int]:
    return actions[0, :, 0].int().tolist()


def test_idle_pushes_come_last_and_both_parts_keep_their_order() -> None:
    actions, path, state = motions(0.001, 0.05, 0.0, 0.04)
    ordered, centers = idle_last(actions, path, state, 4, 0.01)
    assert order(ordered) == [1, 3, 0, 2]
    assert torch.equal(centers[0, :2], path[0, [1, 3]])


def test_after_the_idle_pushes_everything_is_where_the_segment_ends() -> None:
    actions, path, state = motions(0.001, 0.05, 0.0, 0.04, 0.07)  # the last belongs to the next segment
    _, centers = idle_last(actions, path, state, 4, 0.01)
    assert torch.equal(centers[0, 2:4], path[0, [3, 3]])
    assert torch.equal(centers[0, 4], path[0, 4])
    everything_idle = motions(0.001, 0.0, 0.002)
    assert torch.equal(idle_last(*everything_idle, 3, 0.01)[1], everything_idle[1])


@pytest.mark.parametrize(
    ("blocked", "expected"), [([1], [0, 1, 2]), ([0], [1, 2, 0]), ([0, 1], [1, 2, 0]), ([], [1, 2, 0])]
)
def test_a_push_that_touches_down_on_an_object_is_not_put_first(blocked: list[int], expected: list[int]) -> None:
    actions, path, state = motions(0.001, 0.05, 0.04)
    actions = actions / 10.0  # starts at 0, 0.1, 0.2 of a box of 1 m by 2 m around (0.5, 0)
    low, high = torch.tensor([[0.0, -1.0]]), torch.tensor([[1.0, 1.0]])
    points = torch.tensor([[[0.5 + 0.05 * number, 0.1 * number] for number in blocked] + 40 * [[torch.inf, torch.inf]]])
    ordered, _ = idle_last(actions, path, state, 3, 0.01, ObservedPoints(points, low, high), 0.01)
    assert (10.0 * ordered[0, :, 0]).round().int().tolist() == expected


def test_without_a_distance_nothing_changes() -> None:
    assert order(idle_last(*motions(0.0, 0.05, 0.0), 3, 0.0)[0]) == [0, 1, 2]


def test_only_the_first_segment_is_put_in_order() -> None:
    assert order(idle_last(*motions(0.0, 0.05, 0.0, 0.05), 2, 0.01)[0]) == [1, 0, 2, 3]


def test_the_planner_begins_with_a_push_that_moves_something(toy: SimpleNamespace) -> None:
    class Hesitant(toy.PointMass):
        """The first push of a segment stays where it is."""

        def actions(self, state: State, effect_code: torch.Tensor, motion_code: torch.Tensor) -> torch.Tensor:
            pushes = super().actions(state, effect_code, motion_code)
            return torch.cat([0.0 * pushes[..., :1, :], pushes[..., 1:, :]], -2)

    state = toy.scenes([[(0.0, 0.0)]])
    reward = toy.GoalDisc(goal=(0.2, 0.0))
    plans = [
        toy.plain(Hesitant(), reward, samples=64, horizon=6, idle_distance=idle).plan(state, toy.generators(1))
        for idle in (0.0, 0.01)
    ]
    assert plans[0].actions[0, 0].abs().max() == 0.0
    assert plans[1].actions[0, 0].abs().max() > 0.0
    assert torch.equal(plans[1].actions[0, 0], plans[0].actions[0, 1])
    assert torch.equal(plans[1].predicted_centers[0, 0], plans[0].predicted_centers[0, 1])
