"""Statistics of hand-made windows whose values are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from torch import Tensor

from cavin_pyro.criticism.statistics.pushing import Nearness, statistics_of
from cavin_pyro.criticism.statistics.windows import Outcome
from envs.workspace import normalised_push
from models.state import State

NEAR = Nearness(pair=0.05, tool=0.04)


def outcome(centers: list[list[list[float]]], pushes: list[list[float]], subgoal: list[list[float]]) -> Outcome:
    """One window: planar centres before and after each push, pushes (x, y, dx, dy) in metres; and padding."""

    def padded(points: Tensor) -> Tensor:
        return torch.nn.functional.pad(points, (0, 1, 0, 1))  # height 0, and one object that is not there

    states = padded(torch.tensor([centers]))
    real = torch.tensor([[True] * len(centers[0]) + [False]])
    wanted = np.array(pushes)
    actions = torch.from_numpy(normalised_push(wanted[:, :2], wanted[:, 2:])).float()[None]
    first = State(states[:, 0], torch.zeros(*real.shape, 4), real)
    return Outcome(first, actions, states[:, 1:], padded(torch.tensor([subgoal])))


def values(made: Outcome, near: Nearness = NEAR) -> dict[str, Tensor]:
    segment = made.actions.shape[-2]
    return {statistic.name: statistic.function(made)[0] for statistic in statistics_of(near, segment)}


@pytest.fixture
def pushed() -> Outcome:
    """Two objects 0.2 m apart; the first push moves one by 0.06 m, the second misses both by far.

    f lets the second object slip by 0.012 m in the second push; h wants the first 0.16 m further, at the second.
    """
    return outcome(
        centers=[[[0.5, 0.0], [0.7, 0.0]], [[0.56, 0.0], [0.7, 0.0]], [[0.56, 0.0], [0.7, 0.012]]],
        pushes=[[0.42, 0.0, 0.1, 0.0], [0.5, 0.4, 0.0, 0.1]],
        subgoal=[[0.66, 0.0], [0.7, 0.0]],
    )


def test_moves_are_of_the_farthest_object_and_of_those_beyond_a_centimetre(pushed: Outcome) -> None:
    found = values(pushed)
    assert found["farthest_move_h"].item() == pytest.approx(0.16, abs=1e-6)
    assert found["farthest_move_f"].item() == pytest.approx(0.06, abs=1e-6)
    assert (found["moved_objects_h"].item(), found["moved_objects_f"].item()) == (1.0, 2.0)


def test_objects_inside_each_other_are_counted_as_pairs(pushed: Outcome) -> None:
    found = values(pushed)
    assert (found["close_pairs_h"].item(), found["close_pairs_f"].item()) == (1.0, 0.0)
    assert values(pushed, Nearness(pair=0.15, tool=0.04))["close_pairs_f"].item() == 1.0


def test_pushes_start_where_they_start(pushed: Outcome) -> None:
    found = values(pushed)
    aside = math.hypot(0.06, 0.4)  # from (0.5, 0.4) to the first object, which lies at (0.56, 0) by then
    assert found["start_to_nearest"].tolist() == pytest.approx([0.08, aside], abs=1e-6)
    assert found["start_to_moved"][0].item() == pytest.approx(0.08, abs=1e-6)
    assert found["start_to_moved"][1].isnan()  # it slipped, but by less than a push moves things


def test_a_push_touches_along_its_whole_path() -> None:
    still = [[[0.6, 0.0]]] * 4
    passing = [[0.55, 0.039, 0.1, 0.0], [0.55, 0.041, 0.1, 0.0], [0.48, 0.0, 0.07, 0.0]]
    assert values(outcome(still, passing, still[0]))["touching"].item() == pytest.approx(1 / 3)


def test_a_lone_object_is_inside_of_none() -> None:
    lone = outcome([[[0.6, 0.0]]] * 2, [[0.4, 0.3, 0.1, 0.0]], [[0.6, 0.0]])
    assert values(lone)["close_pairs_h"].item() == 0.0
    assert Nearness.of(lone).pair == 0.0


def test_nearness_is_what_real_windows_show() -> None:
    """101 windows whose objects end 0.1 to 0.2 m apart; pushes pass by at 0 to 0.1 m; 51 of them move something."""
    count, offset = 101, torch.linspace(0.0, 0.1, 101)
    first = torch.tensor([[0.5, 0.0, 0.0], [0.6, 0.0, 0.0]]).repeat(count, 1, 1)
    first[:, 1, 0] += offset
    after = first.clone()
    after[:51, :, 1] += 0.05
    start = np.stack([np.full(count, 0.45), offset.numpy()], -1)
    actions = torch.from_numpy(normalised_push(start, np.tile([0.1, 0.0], (count, 1)))).float()[:, None]
    state = State(first, torch.zeros(count, 2, 4), torch.ones(count, 2, dtype=torch.bool))
    near = Nearness.of(Outcome(state, actions, after[:, None], after))
    assert near.pair == pytest.approx(0.101, abs=1e-6)
    assert near.tool == pytest.approx(0.1 * 51 / 101, abs=1e-3)


@given(
    points=arrays.arrays(np.float32, (3, 3), elements=st.floats(0.0, 0.75, width=32)),
    push=arrays.arrays(np.float32, (4,), elements=st.floats(-1.0, 1.0, width=32)),
    order=st.permutations(range(3)),
)
def test_the_order_of_objects_and_their_padding_do_not_matter(
    points: np.ndarray, push: np.ndarray, order: list[int]
) -> None:
    def made(which: list[int], junk: float) -> Outcome:
        centers = torch.from_numpy(points)[which][None]
        centers = torch.cat((centers, torch.full((1, 1, 3), junk)), 1)
        first = State(centers, torch.zeros(1, 4, 4), torch.tensor([[True] * 3 + [False]]))
        return Outcome(first, torch.from_numpy(push)[None, None], (centers * 1.05)[:, None], centers * 0.9)

    for name, value in values(made([0, 1, 2], 0.0)).items():
        if name != "start_to_moved":  # two that move equally far are equally right
            assert torch.allclose(value, values(made(order, 0.3))[name], atol=1e-6, equal_nan=True), name
