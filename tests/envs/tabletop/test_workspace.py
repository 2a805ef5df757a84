"""Reach, pushes, the tile grid, and distances to unions of tiles against brute force."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cavin_pyro.envs.tabletop.tasks.tiles import TileSet, table_distance
from cavin_pyro.envs.tabletop.workspace import (
    MAXIMUM_MOTION,
    REACH_HIGH,
    REACH_LOW,
    TABLE_HIGH,
    TABLE_LOW,
    normalised_push,
    push_endpoints,
    tile_center,
)
from cavin_pyro.envs.world import ACTION_DECIMALS
from cavin_pyro.planning.rollout import project

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
def test_an_executed_push_differs_by_less_than_a_third_of_a_millimetre(actions: np.ndarray) -> None:
    rounded = project(torch.tensor(actions, dtype=torch.float32), ACTION_DECIMALS).numpy()
    assert rounded.dtype == np.float32 and (np.abs(rounded) <= 1.0).all()
    np.testing.assert_array_equal(project(torch.tensor(rounded), ACTION_DECIMALS), rounded)
    for exact, made in zip(push_endpoints(actions), push_endpoints(rounded), strict=True):
        assert (np.abs(exact - made) < 0.00033).all()  # half of 0.55 mm of the start and of 0.1 mm of the motion


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


TILES = st.sets(st.tuples(st.integers(0, 4), st.integers(0, 6)), min_size=1, max_size=20)
X, Y = st.floats(TABLE_LOW[0], TABLE_HIGH[0]), st.floats(TABLE_LOW[1], TABLE_HIGH[1])
CELL = 0.01  # metres; a fifteenth of a tile's side


def cells(tiles: set[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Centres [C, 2] of a fine grid over table and surroundings, and which of them [C] lie in the union."""
    i, j = np.mgrid[-15:90, -15:120]  # fifteen cells to a tile, a tile's width around the grid
    centers = np.stack([0.22 + (i + 0.5) * CELL, -0.56 + (j + 0.5) * CELL], axis=-1).reshape(-1, 2)
    inside = [tile in tiles for tile in zip((i // 15).ravel().tolist(), (j // 15).ravel().tolist(), strict=True)]
    return centers, np.array(inside)


@settings(deadline=None, max_examples=30)
@given(tiles=TILES, points=st.lists(st.tuples(X, Y), min_size=1, max_size=8))
def test_the_signed_distance_agrees_with_a_dense_sampling_of_the_union(tiles: set, points: list) -> None:
    samples, inside = cells(tiles)
    union = TileSet(tiles)
    found = union.signed_distance(torch.tensor(points, dtype=torch.float64)).numpy()
    for point, distance in zip(points, found, strict=True):
        away = np.linalg.norm(samples - point, axis=1)
        to_union, to_rest = away[inside].min(), away[~inside].min()
        wanted = to_union if to_union > to_rest else -to_rest
        assert distance == pytest.approx(wanted, abs=0.75 * CELL)  # half a cell's diagonal


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rounding_leaves_no_gap_between_neighbours(dtype: torch.dtype) -> None:
    union = TileSet([(i, j) for i in range(5) for j in range(7)])
    for axis, count in ((0, 5), (1, 7)):
        for index in range(1, count):
            border = tile_center((index - 0.5, index - 0.5))[axis]
            for offset in np.linspace(-2e-7, 2e-7, 41):
                point = torch.tensor([0.6, 0.0], dtype=dtype)
                point[axis] = border + offset
                assert union.contains(point)
                assert union.signed_distance(point) < -0.1


@settings(deadline=None)
@given(X, Y)
def test_the_distance_to_the_tables_edge_is_that_to_the_nearest_side(x: float, y: float) -> None:
    sides = (x - 0.22, 0.98 - x, y + 0.61, 0.61 - y)
    distance = table_distance(torch.tensor([x, y], dtype=torch.float64))
    assert distance.item() == pytest.approx(min(sides), abs=1e-12)
