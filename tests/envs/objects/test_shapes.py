"""The ten builtin objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from envs.objects.shapes import BUILTIN_NAMES, Shape, builtin_shape, write_mesh

# Millimetres and grams as published with the YCB Object and Model Set (Calli et al. 2015): the sides of the
# boxes, smallest first; diameter and height of what is round; thickness and length of the banana.
BOXES = {
    "sugar_box": ((38, 89, 175), 514),
    "pudding_box": ((35, 89, 110), 187),
    "gelatin_box": ((28, 73, 85), 97),
    "potted_meat_can": ((50, 82, 97), 370),
    "rubiks_cube": ((57, 57, 57), 94),
}
ROUND = {
    "tomato_soup_can": ((66, 101), 349),
    "tuna_fish_can": ((85, 33), 171),
    "mug": ((80, 82), 118),
    "a_cups": ((55, 60), 13),
}
BANANA = ((36, 190), 66)
TOLERANCE = 2.0  # millimetres
ALL_NAMES = [*BOXES, *ROUND, "banana"]


def corners(shape: Shape) -> np.ndarray:
    """[V, 3] millimetres."""
    return 1000 * np.vstack([part.vertices for part in shape.parts])


def holds(part: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Which points [P, 3] lie in a convex part: below the planes of all its faces."""
    offsets = (part.face_normals * part.triangles[:, 0]).sum(axis=1)
    return (points @ part.face_normals.T <= offsets + 1e-9).all(axis=1)


def solid(shape: Shape, points: np.ndarray) -> np.ndarray:
    return np.any([holds(part, points) for part in shape.parts], axis=0)


def test_there_are_the_ten_objects_of_the_paper() -> None:
    assert sorted(BUILTIN_NAMES) == sorted(ALL_NAMES)
    assert len(BUILTIN_NAMES) == 10


@pytest.mark.parametrize("name", BOXES)
def test_boxes_have_their_published_sides(name: str) -> None:
    sides, mass = BOXES[name]
    points = corners(builtin_shape(name))
    np.testing.assert_allclose(sorted(np.ptp(points, axis=0)), sides, atol=TOLERANCE)
    assert builtin_shape(name).mass == pytest.approx(mass / 1000)


@pytest.mark.parametrize("name", ROUND)
def test_round_objects_have_their_published_diameter_and_height(name: str) -> None:
    (diameter, height), mass = ROUND[name]
    shape = builtin_shape(name)
    points = corners(shape) if name != "mug" else corners(Shape(name, shape.parts[:-3], shape.mass))  # no handle
    assert np.ptp(points[:, 2]) == pytest.approx(height, abs=TOLERANCE)
    middle = (points.min(axis=0) + points.max(axis=0))[:2] / 2
    assert 2 * np.linalg.norm(points[:, :2] - middle, axis=1).max() == pytest.approx(diameter, abs=TOLERANCE)
    assert shape.mass == pytest.approx(mass / 1000)


def test_the_banana_has_its_published_thickness_and_length_from_end_to_end() -> None:
    (thickness, length), mass = BANANA
    shape = builtin_shape("banana")
    points = corners(shape)
    assert np.ptp(points[:, 2]) == pytest.approx(thickness, abs=TOLERANCE)
    assert np.ptp(points[:, 0]) == pytest.approx(length, abs=TOLERANCE)
    assert shape.mass == pytest.approx(mass / 1000)


def test_the_banana_is_curved() -> None:
    shape = builtin_shape("banana")
    points = corners(shape) / 1000
    ends = [points[points[:, 0].argmin()], points[points[:, 0].argmax()]]
    chord = np.linspace(*ends, 21)[5:-5]
    assert not solid(shape, chord).any()
    hull = trimesh.convex.convex_hull(points).volume
    assert sum(part.volume for part in shape.parts) < 0.75 * hull


@pytest.mark.parametrize("name", ALL_NAMES)
def test_every_part_is_convex_and_watertight(name: str) -> None:
    for part in builtin_shape(name).parts:
        assert part.is_watertight and part.is_convex
        assert part.volume > 0


@pytest.mark.parametrize("name", ["mug", "a_cups"])
def test_a_ray_down_the_middle_of_a_vessel_meets_its_floor_only(name: str) -> None:
    shape = builtin_shape(name)
    floor = min(shape.parts, key=lambda part: part.vertices[:, 2].max()).bounds
    middle = floor.mean(axis=0)
    heights = np.arange(floor[0, 2], 0.06, 0.0005)
    ray = np.column_stack([np.full_like(heights, middle[0]), np.full_like(heights, middle[1]), heights])
    filled = heights[solid(shape, ray)]
    assert len(filled) > 2
    assert filled.max() <= floor[1, 2] + 1e-9 < floor[0, 2] + 0.005


@pytest.mark.parametrize("name", ["mug", "a_cups"])
def test_a_vessel_has_a_wall_all_around(name: str) -> None:
    shape = builtin_shape(name)
    floor = min(shape.parts, key=lambda part: part.vertices[:, 2].max()).bounds
    middle = floor.mean(axis=0)
    for angle in np.linspace(0, 2 * np.pi, 37):
        distances = np.arange(0.0, 0.05, 0.0005)
        outwards = np.outer(distances, [np.cos(angle), np.sin(angle), 0.0])
        wall = distances[solid(shape, outwards + np.array([*middle[:2], 0.0]))]
        assert len(wall) and wall.min() > 0.015


@pytest.mark.parametrize("name", ALL_NAMES)
def test_the_origin_is_the_centre_of_volume(name: str) -> None:
    shape = builtin_shape(name)
    low, high = corners(shape).min(axis=0) / 1000, corners(shape).max(axis=0) / 1000
    points = np.random.default_rng(0).uniform(low, high, size=(100_000, 3))
    center = points[solid(shape, points)].mean(axis=0)
    # 1.5 mm: the corners where the mug's handle overlaps itself count twice.
    assert np.linalg.norm(center) < 0.0015
    assert shape.radius == pytest.approx(np.linalg.norm(corners(shape), axis=1).max() / 1000)


def test_an_unknown_object_is_named_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"^unknown object 'spoon': choose from sugar_box, .*rubiks_cube$"):
        builtin_shape("spoon")


def test_a_mesh_file_holds_a_group_per_part_and_is_written_once(tmp_path: Path) -> None:
    path = write_mesh(builtin_shape("mug"), tmp_path)
    lines = path.read_text().splitlines()
    assert sum(line.startswith("o ") for line in lines) == len(builtin_shape("mug").parts)
    vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=float)
    np.testing.assert_allclose(1000 * vertices.min(axis=0), corners(builtin_shape("mug")).min(axis=0), atol=1e-3)
    path.write_text("mine")
    assert write_mesh(builtin_shape("mug"), tmp_path).read_text() == "mine"
