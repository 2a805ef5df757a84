"""Reach, pushes and the tile grid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from envs.workspace import (
    MAXIMUM_MOTION,
    REACH_HIGH,
    REACH_LOW,
    TABLE_HIGH,
    TABLE_LOW,
    TILE_COUNT,
    TILE_SIDE,
    executed_push,
    normalised_push,
    push_endpoints,
    tile_center,
)

ACTIONS = arrays(np.float64, (3, 4), elements=st.floats(-2.0, 2.0))
UNIT = st.floats(-1.0, 1.0)


@settings(deadline=None)
@given(ACTIONS)
def test_pushes_start_and_end_within_reach(actions: np.ndarray) -> None:
    for point in push_endpoints(actions):
        assert point.shape == (3, 2)
        assert (point >= REACH_LOW).all() and (point <= REACH_HIGH).all()


@settings(deadline=None)
@given(ACTIONS)
def test_no_push_moves_further_than_a_decimetre_on_an_axis(actions: np.ndarray) -> None:
    start, end = push_endpoints(actions)
    assert (np.abs(end - start) <= MAXIMUM_MOTION + 1e-12).all()


def test_the_corners_of_the_action_are_the_corners_of_the_reach() -> None:
    start, end = push_endpoints(np.array([[-1.0, -1.0, -1.0, -1.0], [1.0, 1.0, 0.5, 1.0], [0.0, 0.0, 0.5, -1.0]]))
    np.testing.assert_allclose(start, [REACH_LOW, REACH_HIGH, (0.55, 0.0)])
    np.testing.assert_allclose(end, [REACH_LOW, REACH_HIGH, (0.60, -0.1)])  # the first two are clipped to the box


@settings(deadline=None)
@given(ACTIONS)
def test_an_executed_push_differs_by_less_than_a_third_of_a_millimetre(actions: np.ndarray) -> None:
    rounded = executed_push(actions)
    assert rounded.dtype == np.float32 and (np.abs(rounded) <= 1.0).all()
    np.testing.assert_array_equal(executed_push(rounded), rounded)
    for exact, made in zip(push_endpoints(actions), push_endpoints(rounded), strict=True):
        assert (np.abs(exact - made) < 0.00033).all()  # half of 0.55 mm of the start and of 0.1 mm of the motion


def test_errors_of_rounding_make_no_other_push() -> None:
    push = np.array([0.1234, -0.5678, 0.9, -1.0])
    for error in (1e-7, -1e-7, 1e-5, -1e-5):
        np.testing.assert_array_equal(executed_push(push + error), executed_push(push))
    assert not np.array_equal(executed_push(push + 1e-3), executed_push(push))
    assert not np.array_equal(executed_push(push + 1e-5, None), executed_push(push, None))


@settings(deadline=None)
@given(st.tuples(UNIT, UNIT), st.tuples(UNIT, UNIT))
def test_a_normalised_push_starts_and_moves_as_asked(start: tuple, motion: tuple) -> None:
    low, high = np.array(REACH_LOW), np.array(REACH_HIGH)
    wanted = low + (np.array(start) + 1) / 2 * (high - low)
    moved = np.array(motion) * MAXIMUM_MOTION
    action = normalised_push(wanted, moved)
    np.testing.assert_allclose(action, [*start, *motion], atol=1e-12)
    began, ended = push_endpoints(action)
    np.testing.assert_allclose(began, wanted, atol=1e-12)
    np.testing.assert_allclose(ended, np.clip(wanted + moved, low, high), atol=1e-12)


@pytest.mark.parametrize("i", range(5))
@pytest.mark.parametrize("j", range(7))
def test_tile_centres_are_those_of_the_published_grid(i: int, j: int) -> None:
    np.testing.assert_allclose(tile_center((i, j)), (0.295 + 0.15 * i, -0.485 + 0.15 * j), atol=1e-12)


def test_the_grid_holds_every_whole_tile_on_the_table() -> None:
    for axis, count in enumerate(TILE_COUNT):
        first, last = (tile_center((index, index))[axis] for index in (0, count - 1))
        assert first - TILE_SIDE / 2 >= TABLE_LOW[axis] - 1e-9
        assert first - TILE_SIDE * 1.5 < TABLE_LOW[axis]
        assert last + TILE_SIDE / 2 <= TABLE_HIGH[axis] + 1e-9
        assert last + TILE_SIDE * 1.5 > TABLE_HIGH[axis]
