"""Tiles on the table: what pictures show of them, and what no measurement does."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from envs.layouts import load_task
from envs.markings import paint_tiles
from envs.pushing import VIDEO_SIZE, PushingEnv
from envs.scene import Scene
from envs.sensors.camera import Camera
from envs.tasks import GOAL_MARKING, TASKS, TileSet
from envs.workspace import TILE_COUNT, tile_center

PICTURE = Camera().resized(*VIDEO_SIZE)


def pixel(x: float, y: float, z: float = 0.0) -> tuple[int, int]:
    column, row = PICTURE.project(np.array([x, y, z])).astype(int)
    return int(row), int(column)


@pytest.mark.parametrize("task", TASKS)
def test_the_camera_sees_and_measures_the_same_with_tiles_and_without(task: str) -> None:
    observed, pictures = [], []
    for show_tiles in (True, False):
        env = PushingEnv(task=task, objects=3, render_mode="rgb_array", show_tiles=show_tiles)
        observation, _ = env.reset(seed=2)
        pictures.append(env.render())
        rendering = env.scene.world.render(env.scene.camera)
        after, *_ = env.step(np.array([0.1, 0.2, 0.9, -0.4], dtype=np.float32))
        observed.append([rendering.depth, rendering.bodies, rendering.color, *observation.values(), *after.values()])
        env.close()
    for one, other in zip(*observed, strict=True):
        np.testing.assert_array_equal(one, other)
    changed = (pictures[0] != pictures[1]).any(axis=-1).mean()
    assert 0.02 < changed < 0.5


@pytest.mark.parametrize("task", ["clearing", "insertion", "crossing"])
@pytest.mark.parametrize("number", [0, 1, 2])
def test_exactly_the_tiles_of_the_layout_are_painted(task: str, number: int, scene: Scene, put: Callable) -> None:
    layout = load_task(task, number)
    goal = getattr(layout, "goal", TileSet([]))
    scene.reset([put("rubiks_cube", 0.9, 0.55)], np.random.default_rng(0))  # off the tile grid
    scene.markings = ()
    plain = scene.photograph(PICTURE)
    scene.markings = layout.tile_groups()
    painted = scene.photograph(PICTURE)
    for i in range(TILE_COUNT[0]):
        for j in range(TILE_COUNT[1]):
            where = pixel(*tile_center((i, j)))
            assert (painted[where] != plain[where]).any() == ((i, j) in {*layout.region, *goal})
            red, green, blue = (int(value) for value in painted[where])
            assert (red > green > 2 * blue) == ((i, j) in goal)  # gold
    assert GOAL_MARKING.color not in {group.color for group in layout.tile_groups() if group.name != "goal"}


def test_objects_hide_tiles(scene: Scene, put: Callable) -> None:
    x, y = tile_center((2, 2))
    scene.markings = ()
    scene.reset([put("rubiks_cube", x, y)], np.random.default_rng(0))
    plain = scene.photograph(PICTURE)
    scene.markings = load_task("crossing", 0).tile_groups()
    painted = scene.photograph(PICTURE)
    on_top, beside = pixel(x, y, 0.057), pixel(x + 0.06, y + 0.06)
    np.testing.assert_array_equal(painted[on_top], plain[on_top])
    assert (painted[beside] != plain[beside]).any()
    body = scene.world.render(PICTURE).bodies == scene.bodies[0]
    np.testing.assert_array_equal(painted[body], plain[body])


def test_colours_differ_without_red_or_without_green() -> None:
    """Goals from what surrounds them, as people see them who lack a kind of cones (Viénot et al., 1999)."""
    lacking = {
        "red": np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]]),
        "green": np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]]),
    }
    table = np.array([0.80, 0.77, 0.72])
    for task in ("insertion", "crossing"):
        shown = [table]
        for group in load_task(task, 0).tile_groups():
            color = np.array([int(group.color[start : start + 2], 16) / 255 for start in (1, 3, 5)])
            shown.append(group.opacity * color + (1 - group.opacity) * table)
        for matrix in lacking.values():
            linear = [matrix @ color**2.2 for color in shown]
            for one in range(3):
                for other in range(one):
                    assert np.abs(linear[one] - linear[other]).max() > 0.1


def test_a_picture_is_copied_and_pixels_off_the_grid_are_left_alone() -> None:
    picture = np.full((2, 2, 3), 100, dtype=np.uint8)
    rows, columns = np.array([0, 0, 1]), np.array([0, 1, 0])
    places = np.array([tile_center((1, 2)), (9.0, 9.0), tile_center((0, 0))])
    groups = [group for group in load_task("crossing", 0).tile_groups() if group.name == "goal"]
    painted = paint_tiles(picture, rows, columns, places, groups)
    assert (picture == 100).all()
    changed = (painted != 100).any(axis=-1)
    np.testing.assert_array_equal(changed, [[True, False], [False, False]])
