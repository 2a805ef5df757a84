"""Distances to unions of tiles, against brute force."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.tasks.tiles import TileSet, table_distance
from envs.workspace import TABLE_HIGH, TABLE_LOW, tile_center

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


@settings(deadline=None)
@given(tiles=TILES)
def test_a_union_contains_the_middles_of_its_tiles_and_of_no_others(tiles: set) -> None:
    grid = [(i, j) for i in range(-1, 6) for j in range(-1, 8)]
    middles = torch.tensor([tile_center(tile) for tile in grid])
    union = TileSet(tiles)
    assert union.contains(middles).tolist() == [tile in tiles for tile in grid]
    assert (union.signed_distance(middles) < 0).tolist() == [tile in tiles for tile in grid]


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


def test_borders_belong_to_the_union_and_have_no_distance() -> None:
    union = TileSet([(2, 3)])
    x, y = tile_center((2, 3))
    border = torch.tensor([[x + 0.075, y], [x, y - 0.075], [x - 0.075, y + 0.075]], dtype=torch.float64)
    inwards = torch.tensor([x, y], dtype=torch.float64) - border
    assert union.contains(border + 1e-9 * inwards).all()
    assert not union.contains(border - 1e-9 * inwards).any()
    torch.testing.assert_close(union.signed_distance(border), torch.zeros(3, dtype=torch.float64))


@settings(deadline=None)
@given(tiles=TILES, shape=st.sampled_from([(), (1,), (3, 2), (2, 1, 4)]))
def test_distances_keep_leading_dimensions_and_precision(tiles: set, shape: tuple) -> None:
    union = TileSet(tiles)
    points = torch.rand(*shape, 2, dtype=torch.float64)
    for found in (union.signed_distance(points), union.contains(points), table_distance(points)):
        assert found.shape == shape
    assert union.signed_distance(points).dtype == table_distance(points).dtype == torch.float64
    singles = [union.signed_distance(point) for point in points.reshape(-1, 2)]
    assert torch.equal(union.signed_distance(points).reshape(-1), torch.stack(singles))
    single = union.signed_distance(points.float())
    assert single.dtype == torch.float32


@settings(deadline=None)
@given(X, Y)
def test_the_distance_to_the_tables_edge_is_that_to_the_nearest_side(x: float, y: float) -> None:
    sides = (x - 0.22, 0.98 - x, y + 0.61, 0.61 - y)
    found = table_distance(torch.tensor([x, y], dtype=torch.float64))
    assert found.item() == pytest.approx(min(sides), abs=1e-12)


def test_points_off_the_table_are_at_a_negative_distance_from_its_edge() -> None:
    off = torch.tensor([[0.21, 0.0], [1.0, 0.0], [0.6, -0.7], [0.6, 0.62]])
    torch.testing.assert_close(table_distance(off), torch.tensor([-0.01, -0.02, -0.09, -0.01]))
