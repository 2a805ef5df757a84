"""Pushing, seeing and drawing: the simulated table without any task."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cavin_pyro.envs.layouts import load_task
from cavin_pyro.envs.objects.sampling import WHOLE_TABLE, Area, ObjectRanges
from cavin_pyro.envs.objects.shapes import BUILTIN_NAMES
from cavin_pyro.envs.physics import PhysicsWorld
from cavin_pyro.envs.physics.visuals import Part
from cavin_pyro.envs.pushing import VIDEO_SIZE, PushingEnv
from cavin_pyro.envs.robots.robot import SETTLED_SPEED, STICK_RADIUS
from cavin_pyro.envs.scene import Scene
from cavin_pyro.envs.sensors.camera import Camera
from cavin_pyro.envs.tasks import TileSet
from cavin_pyro.envs.tasks.task import GOAL_MARKING
from cavin_pyro.envs.workspace import (
    OBJECT_SLOTS,
    POINTS_PER_OBJECT,
    TILE_COUNT,
    normalised_push,
    push_endpoints,
    tile_center,
)

REACHABLE: Area = (((0.40, -0.35), (0.70, 0.35)),)
RANGES = ObjectRanges(clearance=0.12)
LYING_ALONG_Y = (-0.5, -0.5, -0.5, 0.5)  # a box flat on the table, its longest side along y


def generators(seed: int) -> Iterator[np.random.Generator]:
    return iter(np.random.default_rng(seed).spawn(2))


def truth(scene: Scene) -> np.ndarray:
    """Positions and orientations of all objects, exactly: [M, 7]."""
    poses = scene.ground_truth()
    return np.concatenate([poses.positions, poses.orientations], axis=1)


def gap(scene: Scene, tool_at: np.ndarray, number: int = 0) -> float:
    """Metres between the tool, were it at [2], and the nearest point that was observed of an object."""
    cloud = scene.observe().clouds[number, :, :2]
    return float(np.linalg.norm(cloud - tool_at, axis=1).min()) - STICK_RADIUS


def history(scene: Scene, seed: int, pushes: int = 4) -> list[np.ndarray]:
    """Everything that a short episode of fixed actions leaves behind."""
    sampling, acting = generators(seed)
    observed = scene.sample([REACHABLE] * 4, RANGES, sampling)
    states = [truth(scene), observed.clouds]
    for _ in range(pushes):
        scene.push(acting.uniform(-1, 1, size=4))
        observed = scene.observe()
        states += [truth(scene), observed.clouds, observed.visible]
    return states


@pytest.mark.parametrize("seed", [2, 4])
def test_a_sampled_scene_has_settled_on_the_table(scene: Scene, seed: int) -> None:
    (sampling, _) = generators(seed)
    count = 1 + seed % OBJECT_SLOTS
    observed = scene.sample([WHOLE_TABLE] * count, RANGES, sampling)
    assert scene.world.fastest(scene.bodies) < SETTLED_SPEED
    before = truth(scene)
    assert before.shape == (count, 7) and (before[:, 2] > 0).all()
    for _ in range(240):
        scene.world.step()
    np.testing.assert_allclose(truth(scene)[:, :3], before[:, :3], atol=0.003)
    assert observed.mask.tolist() == observed.visible.tolist() == [True] * count + [False] * (OBJECT_SLOTS - count)


@pytest.mark.parametrize("name", BUILTIN_NAMES)
def test_every_object_stands_where_it_was_put(scene: Scene, put: Callable, name: str) -> None:
    one = put(name, 0.55, 0.1)
    scene.reset([one], np.random.default_rng(0))
    poses = scene.ground_truth()
    np.testing.assert_allclose(poses.positions[0], one.position, atol=0.004)
    turn = Rotation.from_quat(poses.orientations[0]).magnitude()
    assert turn < (0.2 if name == "banana" else 0.01)  # radians; a banana has no flat side


@pytest.mark.parametrize("name", BUILTIN_NAMES)
def test_a_pushed_object_moves_forward_and_stops_where_the_tool_stops(
    scene: Scene, put: Callable, push: Callable, name: str
) -> None:
    direction = (0.0, -0.1) if name in ("mug", "banana") else (0.1, 0.0)
    lying = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))  # a box 38 mm deep and 175 mm high topples when it is pushed
    posture = {"orientation": lying} if name == "sugar_box" else {}
    scene.reset([put(name, 0.55, 0.0, **posture)], np.random.default_rng(0))
    forward = np.array(direction) / 0.1
    before = scene.ground_truth().positions[0, :2]
    # 6 cm behind the surface, so that 4 cm of the push remain for the object.
    start = before - forward * 0.3
    start += forward * (gap(scene, start) - 0.06)
    action = push(*start, *direction)
    report = scene.push(action)
    assert not report.unsafe and not report.ineffective and not report.fallen
    assert report.moved.shape == (1,) and report.moved[0] > 0.01
    assert (scene.ground_truth().positions[0, :2] - before) @ forward > 0.005
    _, end = push_endpoints(action)
    assert abs(gap(scene, end)) < 0.015


def test_a_push_is_filmed_by_whoever_asks(put: Callable, push: Callable) -> None:
    frames: list[int] = []
    filmed = Scene(on_frame=lambda: frames.append(1))
    filmed.reset([put("rubiks_cube", 0.55, 0.0)], np.random.default_rng(0))
    filmed.push(push(0.4, 0.3, 0.1, 0.0))
    assert len(frames) == 8
    filmed.push(push(0.55, 0.0, 0.1, 0.0))  # unsafe: nothing to film
    assert len(frames) == 8
    filmed.close()
    filmed.close()


def test_an_object_pushed_off_the_table_has_fallen_and_keeps_its_latest_cloud(
    scene: Scene, put: Callable, push: Callable
) -> None:
    box = put("sugar_box", 0.55, 0.50, orientation=LYING_ALONG_Y)  # beside the edge, pushed until it tips over
    scene.reset([put("rubiks_cube", 0.45, 0.0), box], np.random.default_rng(0))
    report = max((scene.push(push(0.55, 0.39 + 0.05 * n, 0.0, 0.1)) for n in range(4)), key=lambda one: one.fallen)
    assert report.fallen and not report.unsafe
    assert scene.ground_truth().positions[1, 2] < -0.5
    observed = scene.observe()
    assert (observed.visible[:2].tolist(), observed.mask[:2].tolist()) == ([True, False], [True, True])
    assert np.isfinite(observed.clouds).all() and observed.centers[1, 1] > 0.4


def test_equal_seeds_and_actions_give_equal_states_whatever_came_before(scene: Scene) -> None:
    fresh = Scene()
    first = history(fresh, seed=3)
    other = history(scene, seed=4)  # another past for the shared world
    for left, right in zip(history(scene, seed=3), first, strict=True):
        np.testing.assert_array_equal(left, right)
    assert not np.array_equal(first[0], other[0])
    assert any(not np.array_equal(first[0], state) for state in first[2::3]), "some push moved something"
    fresh.close()


def test_restored_bodies_are_where_they_were_and_the_same_push_ends_alike(scene: Scene, put: Callable) -> None:
    scene.reset([put("rubiks_cube", 0.5, 0.0), put("rubiks_cube", 0.6, 0.0)], np.random.default_rng(0))
    before, push, ends = scene.ground_truth(), normalised_push(np.array([0.42, 0.0]), np.array([0.1, 0.0])), []
    for _ in range(2):
        scene.push(push)
        ends.append(scene.ground_truth().positions)
        assert np.abs(ends[-1] - before.positions).max() > 0.01
        scene.world.restore(scene.bodies, before)
        np.testing.assert_allclose(scene.ground_truth().positions, before.positions, atol=1e-9)
        np.testing.assert_allclose(scene.ground_truth().orientations, before.orientations, atol=1e-9)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-3)  # metres; contacts are not what they were


def test_an_observation_has_a_cloud_per_object_and_zeros_for_padding(scene: Scene, put: Callable) -> None:
    observed = scene.reset([put("mug", 0.5, 0.2), put("banana", 0.6, -0.2)], np.random.default_rng(0))
    assert observed.clouds.shape == (OBJECT_SLOTS, POINTS_PER_OBJECT, 3)
    assert observed.clouds.dtype == observed.centers.dtype == np.float32
    np.testing.assert_allclose(observed.centers, observed.clouds.mean(axis=1), atol=2e-3)  # of a sample of the points
    assert not observed.clouds[2:].any() and not observed.centers[2:].any()
    poses = scene.ground_truth().positions
    np.testing.assert_allclose(observed.centers[:2, :2], poses[:, :2], atol=0.02)  # half of an object is hidden


def in_world(part: Part, world: PhysicsWorld) -> np.ndarray:
    """The part's vertices [V, 3] metres where they are now."""
    pose = world.link_poses([(part.body, part.link)])
    return Rotation.from_quat(pose.orientations[0]).apply(part.vertices) + pose.positions[0]


def test_every_body_is_drawn_where_the_camera_sees_it() -> None:
    env = PushingEnv(task="crossing", objects=5)
    observation, _ = env.reset(seed=3)
    world = env.scene.world
    parts = {part.body: part for part in world.parts()}
    assert len(parts) == 7  # the table, five objects and the tool
    for slot, body in enumerate(env.scene.bodies):
        vertices, cloud = in_world(parts[body], world), observation["clouds"][slot]
        # The camera's pixels are 5 mm wide on the table.
        assert (cloud > vertices.min(axis=0) - 0.006).all()
        assert (cloud < vertices.max(axis=0) + 0.006).all()
        assert cloud[:, 2].max() == pytest.approx(vertices[:, 2].max(), abs=0.006)
    env.close()


PICTURE = Camera().resized(*VIDEO_SIZE)


def pixel(x: float, y: float, z: float = 0.0) -> tuple[int, int]:
    column, row = PICTURE.project(np.array([x, y, z])).astype(int)
    return int(row), int(column)


@pytest.mark.parametrize("task", ["crossing", "rearrange"])
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
def test_exactly_the_tiles_of_the_layout_are_painted(task: str, scene: Scene, put: Callable) -> None:
    layout = load_task(task, 0)
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
