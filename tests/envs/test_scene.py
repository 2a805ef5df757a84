"""Pushing, seeing and hiding: the simulated table without any task."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from envs.objects.sampling import WHOLE_TABLE, Area, ObjectRanges
from envs.objects.shapes import BUILTIN_NAMES
from envs.physics import PhysicsWorld
from envs.robots import RETRACTED, SETTLED_SPEED, STICK_RADIUS
from envs.scene import COLORS, MOVED, TURNED, PushReport, Scene
from envs.sensors.camera import Camera
from envs.workspace import MAXIMUM_OBJECTS, OBJECT_SLOTS, POINTS_PER_OBJECT, normalised_push, push_endpoints

ROOT = Path(__file__).parents[2]
REACHABLE: Area = (((0.40, -0.35), (0.70, 0.35)),)
RANGES = ObjectRanges(clearance=0.12)
LYING_ALONG_Y = (-0.5, -0.5, -0.5, 0.5)  # a box flat on the table, its longest side along y
EMPTY_CORNER = np.array([-1.0, -1.0, 0.5, 0.5])


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


# Rest.


@pytest.mark.parametrize("seed", range(6))
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


def test_objects_do_not_creep_during_pushes_elsewhere(scene: Scene, put: Callable, push: Callable) -> None:
    objects = [put("banana", 0.6, 0.4), put("a_cups", 0.4, 0.4), put("tomato_soup_can", 0.6, 0.2)]
    scene.reset([*objects, put("rubiks_cube", 0.5, -0.3)], np.random.default_rng(0))
    before = truth(scene)
    for _ in range(5):
        scene.push(push(0.45, -0.3, 0.1, 0.0))
        scene.push(push(0.70, -0.3, -0.1, 0.0))
    after = truth(scene)
    assert np.linalg.norm(after[3] - before[3]) > 0.02
    np.testing.assert_allclose(after[:3], before[:3], atol=1e-5)


# Pushes.


@pytest.mark.parametrize("name", BUILTIN_NAMES)
@pytest.mark.parametrize("direction", [(0.1, 0.0), (0.0, -0.1)])
def test_a_pushed_object_moves_forward_and_stops_where_the_tool_stops(
    scene: Scene, put: Callable, push: Callable, name: str, direction: tuple[float, float]
) -> None:
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


def test_a_push_onto_an_object_is_unsafe_and_moves_nothing(scene: Scene, put: Callable, push: Callable) -> None:
    scene.reset([put("rubiks_cube", 0.55, 0.0), put("mug", 0.55, 0.2)], np.random.default_rng(0))
    before = truth(scene)
    report = scene.push(push(0.55, 0.01, 0.1, 0.0))
    assert report.unsafe and report.ineffective and not report.fallen
    np.testing.assert_array_equal(report.moved, [0.0, 0.0])
    np.testing.assert_array_equal(truth(scene), before)


def test_a_push_in_empty_space_is_safe_and_ineffective(scene: Scene, put: Callable, push: Callable) -> None:
    scene.reset([put("rubiks_cube", 0.55, 0.0)], np.random.default_rng(0))
    before = truth(scene)
    report = scene.push(push(0.4, 0.3, 0.1, 0.1))
    assert report.ineffective and not report.unsafe
    np.testing.assert_allclose(truth(scene), before, atol=1e-5)


def test_an_object_that_only_turns_is_not_reported_as_unmoved(scene: Scene, put: Callable, push: Callable) -> None:
    scene.reset([put("sugar_box", 0.55, 0.0, orientation=LYING_ALONG_Y)], np.random.default_rng(0))
    before = Rotation.from_quat(scene.ground_truth().orientations[0])
    surface = 0.55 - 0.089 / 2 - STICK_RADIUS
    report = scene.push(push(surface - 0.08, 0.08, 0.089, 0.0))  # 9 mm against one end
    turn = (Rotation.from_quat(scene.ground_truth().orientations[0]) * before.inv()).magnitude()
    assert turn > TURNED and report.moved[0] < MOVED
    assert not report.ineffective


@pytest.mark.parametrize("onto_the_cube", [False, True])
def test_the_tool_leaves_the_view_after_a_push(
    scene: Scene, put: Callable, push: Callable, onto_the_cube: bool
) -> None:
    scene.reset([put("rubiks_cube", 0.55, 0.0)], np.random.default_rng(0))
    report = scene.push(push(0.55 if onto_the_cube else 0.4, 0.0, 0.0, 0.1))
    assert report.unsafe == onto_the_cube
    assert RETRACTED[2] > scene.camera.position[2]
    in_view = set(np.unique(scene.world.render(scene.camera).bodies).tolist())
    assert in_view - {-1} == {0, scene.bodies[0]}  # the table and the cube


@pytest.mark.parametrize(
    "action",
    [[0.0, 0.0, np.nan, 0.0], [np.inf, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [[0.0] * 4], 0.5],
)
def test_an_action_that_is_not_four_finite_numbers_is_refused(scene: Scene, put: Callable, action: list) -> None:
    scene.reset([put("rubiks_cube", 0.55, 0.0)], np.random.default_rng(0))
    before = truth(scene)
    with pytest.raises(ValueError, match=r"^an action is four finite numbers \(x, y, dx, dy\), not ") as caught:
        scene.push(np.array(action))
    assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(truth(scene), before)


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


# Falls.


def off_the_edge(scene: Scene, put: Callable, push: Callable) -> PushReport:
    """A long box beside the table's edge, pushed until it tips over, with a cube that stays."""
    box = put("sugar_box", 0.55, 0.50, orientation=LYING_ALONG_Y)
    scene.reset([put("rubiks_cube", 0.45, 0.0), box], np.random.default_rng(0))
    assert scene.ground_truth().positions[1, 2] > 0
    return max((scene.push(push(0.55, 0.39 + 0.05 * n, 0.0, 0.1)) for n in range(4)), key=lambda one: one.fallen)


def test_an_object_pushed_off_the_table_has_fallen(scene: Scene, put: Callable, push: Callable) -> None:
    report = off_the_edge(scene, put, push)
    assert report.fallen and not report.unsafe
    assert scene.ground_truth().positions[1, 2] < -0.5


def test_a_fallen_object_keeps_its_latest_cloud(scene: Scene, put: Callable, push: Callable) -> None:
    off_the_edge(scene, put, push)
    observed = scene.observe()
    assert observed.visible.tolist() == [True] + [False] * 4
    assert observed.mask.tolist() == [True, True] + [False] * 3
    assert np.isfinite(observed.clouds).all() and observed.centers[1, 1] > 0.4
    scene.push(EMPTY_CORNER)  # what has fallen does not trouble later pushes


# Seeing.


def test_a_scene_whose_objects_are_not_all_visible_is_not_sampled() -> None:
    scene = Scene(camera=Camera(position=(0.6, -0.3, 0.4)))
    hidden: Area = (((0.5, 0.35), (0.7, 0.45)),)
    with pytest.raises(ValueError, match=r"^no room for 1 objects: none of 50 scenes") as caught:
        scene.sample([hidden], ObjectRanges(names=("rubiks_cube",)), np.random.default_rng(0))
    assert "\n" not in str(caught.value)
    scene.close()


def test_only_acceptable_scenes_are_sampled(scene: Scene) -> None:
    offered: list[float] = []

    def acceptable(observed: object) -> bool:
        offered.append(float(observed.centers[0, 0]))
        return len(offered) == 3

    observed = scene.sample([WHOLE_TABLE], ObjectRanges(), np.random.default_rng(0), acceptable=acceptable)
    assert len(offered) == len(set(offered)) == 3
    assert observed.centers[0, 0] == np.float32(offered[-1])


@pytest.mark.parametrize("count", [0, 6])
def test_a_scene_holds_one_to_five_objects(scene: Scene, put: Callable, count: int) -> None:
    with pytest.raises(ValueError, match=rf"^a scene holds 1 to 5 objects, not {count}$"):
        scene.reset([put("rubiks_cube", 0.3 + 0.1 * n, 0.0) for n in range(count)], np.random.default_rng(0))


def test_a_scene_with_more_slots_holds_more_objects_each_of_its_colour(put: Callable) -> None:
    crowded = Scene(slots=12)
    objects = [put("rubiks_cube", 0.35 + 0.12 * (n % 4), -0.2 + 0.2 * (n // 4)) for n in range(11)]
    observed = crowded.reset(objects, np.random.default_rng(0))
    assert observed.visible.tolist() == observed.mask.tolist() == [True] * 11 + [False]
    assert observed.clouds.shape == (12, POINTS_PER_OBJECT, 3)
    assert len(set(COLORS)) == MAXIMUM_OBJECTS
    crowded.close()


def test_a_photograph_shows_an_orange_target(scene: Scene, put: Callable) -> None:
    scene.reset([put("rubiks_cube", 0.6, 0.3), put("rubiks_cube", 0.6, -0.3)], np.random.default_rng(0))
    camera = scene.camera.resized(512, 424)
    image = scene.photograph(camera)
    assert image.shape == (424, 512, 3) and image.dtype == np.uint8
    (column, row), (other_column, other_row) = camera.project(scene.ground_truth().positions).astype(int)
    red, _, blue = image[row, column].astype(int)
    assert red > 2 * blue
    red, _, blue = image[other_row, other_column].astype(int)
    assert red < blue


def test_the_time_is_booked_where_it_goes(scene: Scene, put: Callable, push: Callable) -> None:
    before = dict(scene.seconds)
    scene.reset([put("mug", 0.55, 0.0)], np.random.default_rng(0))
    scene.push(push(0.45, 0.0, 0.1, 0.0))
    assert set(before) == {"physics", "rendering", "segmentation", "points"}
    assert all(scene.seconds[name] > before[name] for name in before)


# Hollow vessels.


def test_the_tool_fits_into_a_mug_and_not_into_a_can(scene: Scene, put: Callable) -> None:
    scene.reset([put("mug", 0.5, 0.2, scale=1.2), put("tomato_soup_can", 0.5, -0.2)], np.random.default_rng(0))
    (mug, can), tool = scene.bodies, scene.robot._tool
    floor = scene.ground_truth().positions[0, :2] - 1.2 * np.array([0.008, 0.0])  # the handle pulls the origin
    inside = []
    for body, place in ((mug, floor), (can, scene.ground_truth().positions[1, :2])):
        scene.world.place(tool, (*place, 0.1), (0.0, 0.0, 0.0))
        inside.append(not scene.world.overlaps(tool, body))
    scene.world.place(tool, RETRACTED, (0.0, 0.0, 0.0))
    assert inside == [True, False]


# Equal seeds, equal states.


def assert_equal_histories(one: list[np.ndarray], other: list[np.ndarray]) -> None:
    assert len(one) == len(other)
    for left, right in zip(one, other, strict=True):
        np.testing.assert_array_equal(left, right)


def test_equal_seeds_and_actions_give_equal_states_whatever_came_before(scene: Scene) -> None:
    fresh = Scene()
    first = history(fresh, seed=3)
    other = history(scene, seed=4)  # another past for the shared world
    history(scene, seed=5)
    assert_equal_histories(history(scene, seed=3), first)
    assert_equal_histories(history(fresh, seed=4), other)
    assert not np.array_equal(first[0], other[0])
    assert any(not np.array_equal(first[0], state) for state in first[2::3]), "some push moved something"
    fresh.close()


def test_equal_seeds_and_actions_give_equal_states_in_another_process(scene: Scene) -> None:
    script = (
        "import importlib.util, sys, numpy as np\n"
        "spec = importlib.util.spec_from_file_location('scenes', sys.argv[1])\n"
        "module = importlib.util.module_from_spec(spec)\n"
        "spec.loader.exec_module(module)\n"
        "for state in module.history(module.Scene(), seed=3): sys.stdout.buffer.write(state.tobytes())\n"
    )
    command = [sys.executable, "-c", script, str(Path(__file__).resolve())]
    elsewhere = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=120)
    assert elsewhere.stdout == b"".join(state.tobytes() for state in history(scene, seed=3))


def test_two_worlds_side_by_side_do_not_touch_each_other(put: Callable, push: Callable) -> None:
    one, other = Scene(), Scene()
    for scene in (one, other):
        scene.reset([put("mug", 0.55, 0.0)], np.random.default_rng(0))
    before = truth(other)
    one.push(push(0.45, 0.0, 0.1, 0.0))
    np.testing.assert_array_equal(truth(other), before)
    other.push(push(0.45, 0.0, 0.1, 0.0))
    np.testing.assert_array_equal(truth(other), truth(one))
    one.close()
    np.testing.assert_array_equal(other.observe().mask, [True, False, False, False, False])
    other.close()


def test_a_world_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    world = PhysicsWorld()
    world.close()
    assert capfd.readouterr() == ("", "")


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
