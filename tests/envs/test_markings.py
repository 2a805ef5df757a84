"""Tiles on the table: what pictures show of them, and what no measurement does."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from envs.layouts import load_task
from envs.markings import paint_of
from envs.pushing import VIDEO_SIZE, PushingEnv
from envs.scene import Scene
from envs.sensors.camera import Camera
from envs.sensors.sensor import Rendering
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


def test_a_picture_is_copied_and_what_lies_on_the_table_hides_its_markings() -> None:
    goal = tuple(group for group in load_task("crossing", 0).tile_groups() if group.name == "goal")
    one, other = pixel(*tile_center((1, 2))), pixel(*tile_center((0, 0)))
    shape = PICTURE.height, PICTURE.width
    flat = Rendering(
        np.full(shape, PICTURE.position[2]), np.zeros(shape, dtype=np.int64), np.full((*shape, 3), 100, dtype=np.uint8)
    )
    painted = paint_of(PICTURE, goal).on(flat, [7])
    assert (flat.color == 100).all()
    assert (painted[one] != 100).any() and (painted[other] == 100).all()
    flat.bodies[one] = 7
    assert (paint_of(PICTURE, goal).on(flat, [7])[one] == 100).all()
    flat.bodies[one] = 0
    flat.depth[one] -= 0.01  # something that is no object
    assert (paint_of(PICTURE, goal).on(flat, [7])[one] == 100).all()


def test_a_place_lies_over_the_tiles() -> None:
    groups = tuple(load_task("crossing", 0).tile_groups())
    (i, j), red = groups[0].tiles[0], (1.0, 0.0, 0.0)
    x, y = tile_center((i, j))
    with_place = paint_of(PICTURE, groups, ((x, y),), (red,))
    shape = PICTURE.height, PICTURE.width
    flat = Rendering(
        np.full(shape, PICTURE.position[2]), np.zeros(shape, dtype=np.int64), np.full((*shape, 3), 100, dtype=np.uint8)
    )
    tiles, both = paint_of(PICTURE, groups).on(flat, []), with_place.on(flat, [])
    np.testing.assert_allclose(both[pixel(x, y)], 0.55 * tiles[pixel(x, y)] + [0.45 * 255, 0, 0], atol=1.0)
    changed = (tiles != both).any(axis=-1)
    assert 0 < changed.mean() < 0.02 and not changed[pixel(x, y + 0.04)]
