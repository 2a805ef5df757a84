"""Pushing, seeing and drawing: the simulated table without any task."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cavin_pyro.envs.tabletop.objects.sampling import WHOLE_TABLE, ObjectRanges
from cavin_pyro.envs.tabletop.objects.shapes import BUILTIN_NAMES
from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.envs.tabletop.robots.robot import SETTLED_SPEED, STICK_RADIUS
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.envs.tabletop.workspace import OBJECT_SLOTS, POINTS_PER_OBJECT, normalised_push, push_endpoints


def gap(scene: Scene, tool_at: np.ndarray, number: int = 0) -> float:
    """Metres between the tool, were it at [2], and the nearest point that was observed of an object."""
    cloud = scene.observe().clouds[number, :, :2]
    return float(np.linalg.norm(cloud - tool_at, axis=1).min()) - STICK_RADIUS


@pytest.mark.parametrize("seed", [2, 4])
def test_a_sampled_scene_has_settled_on_the_table(scene: Scene, seed: int) -> None:
    count = 1 + seed % OBJECT_SLOTS
    observed = scene.sample([WHOLE_TABLE] * count, ObjectRanges(clearance=0.12), np.random.default_rng(seed))
    assert scene.world.fastest(scene.bodies) < SETTLED_SPEED
    before = scene.ground_truth().positions
    assert before.shape == (count, 3) and (before[:, 2] > 0).all()
    for _ in range(240):
        scene.world.step()
    np.testing.assert_allclose(scene.ground_truth().positions, before, atol=0.003)
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


@pytest.mark.parametrize("task", ["crossing", "rearrange"])
def test_the_camera_sees_and_measures_the_same_with_tiles_and_without(task: str) -> None:
    observed, pictures = [], []
    for tiles in (True, False):
        env = PushingEnv(task=task, objects=3, render_mode="rgb_array")
        observation, _ = env.reset(seed=2)
        if not tiles:
            env.scene.markings = env.scene.places = ()
        pictures.append(env.render())
        rendering = env.scene.world.render(env.scene.sensor.nominal)
        after, *_ = env.step(np.array([0.1, 0.2, 0.9, -0.4], dtype=np.float32))
        observed.append([rendering.depth, rendering.bodies, rendering.color, *observation.values(), *after.values()])
        env.close()
    for one, other in zip(*observed, strict=True):
        np.testing.assert_array_equal(one, other)
    changed = (pictures[0] != pictures[1]).any(axis=-1).mean()
    assert 0.02 < changed < 0.5


def test_pixels_that_the_image_has_not_are_refused(
    scene: Scene, put: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene.reset([put("mug", 0.5, 0.0)], np.random.default_rng(0))
    monkeypatch.setattr(scene.segmenter, "follow", lambda image: [(np.array([-5]), np.array([0]))])
    with pytest.raises(ValueError, match=r"^MaskSegmenter must give rows and columns within \[212, 256\]"):
        scene.observe()
