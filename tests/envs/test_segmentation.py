"""Objects found in depth images, with and without the simulator's help."""

from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

import envs.segmentation.clusters as clusters_module
from envs.camera import Camera
from envs.objects import ObjectParameters
from envs.pushing import PushingEnv
from envs.scene import Scene
from envs.segmentation import SEGMENTERS, ClusterSegmenter, MaskSegmenter, segmenter_of
from envs.segmentation.height_map import CELL, ORIGIN, fit_table
from envs.segmentation.regions import split_at_necks
from envs.segmentation.splitting import split_by_shapes
from envs.sensors import CAMERAS, DepthImage

ROOT = Path(__file__).parents[2]
CAMERA = Camera(256, 212, rotation=(0.02, -0.02, 0.01))


@pytest.fixture(scope="module")
def seen_by_kinect() -> Iterator[Scene]:
    scene = Scene(camera="kinect2", segmentation="clusters")
    yield scene
    scene.close()


def table(camera: Camera = CAMERA, *boxes: tuple[float, float, float, float], height: float = 0.05) -> DepthImage:
    """A table seen without noise, with flat-topped boxes (x, y, half x, half y) on it, metres."""
    rows, columns = np.indices((camera.height, camera.width)).reshape(2, -1)
    directions = camera.rays(rows, columns) @ camera.axes
    depth = -camera.position[2] / directions[:, 2]
    for x, y, half_x, half_y in boxes:
        top = (height - camera.position[2]) / directions[:, 2]
        hit = np.array(camera.position) + top[:, None] * directions
        depth = np.where((np.abs(hit[:, 0] - x) < half_x) & (np.abs(hit[:, 1] - y) < half_y), top, depth)
    return DepthImage(depth.reshape(camera.height, camera.width), camera)


def center(image: DepthImage, pixels: tuple) -> np.ndarray:
    return image.camera.points(image.depth, *pixels).mean(axis=0)


def pixel(image: DepthImage, x: float, y: float, z: float = 0.05) -> tuple[int, int]:
    column, row = image.camera.project(np.array([x, y, z])).astype(int)
    return row, column


def test_a_segmenter_that_clusters_is_told_the_depth_and_the_camera_alone() -> None:
    names = set(DepthImage.__dataclass_fields__)
    assert names == {"depth", "camera"}
    assert list(inspect.signature(ClusterSegmenter.follow).parameters) == ["self", "image"]
    assert not inspect.signature(ClusterSegmenter).parameters

    def betray() -> list:
        raise AssertionError("the simulator was asked")

    assert isinstance(segmenter_of("clusters", betray), ClusterSegmenter)
    image = table(CAMERA, (0.6, 0.1, 0.04, 0.04))
    segmenter = SEGMENTERS["clusters"](betray)
    segmenter.start(image, pixel(image, 0.6, 0.1))
    assert len(segmenter.follow(image)) == 1
    assert not {name for name in vars(clusters_module) if "physics" in name.lower()}


def test_the_mask_gives_each_object_its_own_measured_pixels_in_order() -> None:
    two, one = np.array([[0, 0, 1], [0, 1, 1]], bool), np.array([[0, 0, 0], [1, 0, 0]], bool)
    depth = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    first, second, none = MaskSegmenter(lambda: [two, one, np.zeros_like(one)]).start(DepthImage(depth, CAMERA), None)
    assert list(zip(*first, strict=True)) == [(1, 1), (1, 2)]
    assert list(zip(*second, strict=True)) == [(1, 0)]
    assert len(none[0]) == 0


@settings(deadline=None, max_examples=20)
@given(
    st.tuples(*[st.floats(-0.03, 0.03)] * 3),
    st.tuples(*[st.floats(-0.04, 0.04)] * 3),
    st.floats(-0.01, 0.01),
)
def test_the_table_is_found_though_the_cameras_pose_is_not_quite_known(
    rotation: tuple, shift: tuple, error: float
) -> None:
    position = tuple(np.add((0.6, 0.0, 1.0), shift))
    image = table(Camera(256, 212, position, rotation), (0.6, 0.0, 0.1, 0.1), (0.5, 0.4, 0.05, 0.1))
    believed = DepthImage(image.depth, Camera(256, 212, (position[0], position[1], position[2] + error), rotation))
    plane = fit_table(believed)
    assert 1.0 / np.linalg.norm(plane) == pytest.approx(position[2], abs=1e-3)  # the camera's true height


def test_an_image_without_a_table_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^no table in the depth image"):
        ClusterSegmenter().start(DepthImage(np.zeros((212, 256)), CAMERA), None)


def test_the_confirmed_object_comes_first() -> None:
    places = [(0.5, -0.3), (0.6, 0.1), (0.7, 0.3)]
    image = table(CAMERA, *[(x, y, 0.03, 0.03 + 0.01 * n) for n, (x, y) in enumerate(places)])
    for x, y in places:
        first, *_ = found = ClusterSegmenter().start(image, pixel(image, x, y))
        assert len(found) == 3
        np.testing.assert_allclose(center(image, first)[:2], (x, y), atol=0.004)


def test_specks_and_lost_pixels_are_no_objects() -> None:
    image = table(CAMERA, (0.6, 0.1, 0.04, 0.04), (0.5, -0.2, 0.04, 0.04))
    generator = np.random.default_rng(0)
    depth = image.depth.copy()
    for row, column in generator.integers((20, 20), (190, 230), size=(60, 2)):
        depth[row : row + 2, column : column + 2] -= 0.03
    depth[generator.random(depth.shape) < 0.05] = 0.0
    assert len(ClusterSegmenter().start(DepthImage(depth, CAMERA), pixel(image, 0.6, 0.1))) == 2


def test_an_object_is_known_again_where_it_was_pushed_and_when_it_comes_back_to_sight() -> None:
    size = (0.04, 0.03)
    before = table(CAMERA, (0.5, -0.3, *size), (0.6, 0.1, *size), (0.7, 0.3, *size))
    segmenter = ClusterSegmenter()
    first = [center(before, pixels)[:2] for pixels in segmenter.start(before, pixel(before, 0.6, 0.1))]
    pushed = table(CAMERA, (0.5, -0.3, *size), (0.55, 0.2, *size), (0.7, 0.3, *size))
    second = [center(pushed, pixels)[:2] for pixels in segmenter.follow(pushed)]
    np.testing.assert_allclose(second[0], (0.55, 0.2), atol=0.004)
    np.testing.assert_allclose(second[1:], first[1:], atol=0.002)
    hidden = segmenter.follow(table(CAMERA, (0.5, -0.3, *size), (0.7, 0.3, *size)))
    assert [len(rows) > 0 for rows, _ in hidden] == [False, True, True]
    back = segmenter.follow(pushed)
    np.testing.assert_allclose([center(pushed, pixels)[:2] for pixels in back], second, atol=0.002)


def test_what_has_left_the_table_is_not_looked_for_in_what_another_has_become() -> None:
    before = table(CAMERA, (0.6, 0.1, 0.04, 0.03), (0.6, 0.25, 0.03, 0.05))
    segmenter = ClusterSegmenter()
    segmenter.start(before, pixel(before, 0.6, 0.1))
    after = table(CAMERA, (0.6, 0.3, 0.03, 0.05))
    gone, moved = segmenter.follow(after)
    assert len(gone[0]) == 0
    np.testing.assert_allclose(center(after, moved)[:2], (0.6, 0.3), atol=0.004)


def test_a_handle_beside_a_body_is_part_of_it_and_a_like_thing_alone_is_an_object() -> None:
    body, handle = (0.6, 0.1, 0.04, 0.04), (0.6, 0.156, 0.03, 0.01)
    together, apart = table(CAMERA, body, handle), table(CAMERA, body, (0.6, 0.3, 0.03, 0.01))
    assert [len(ClusterSegmenter().start(image, None)) for image in (together, apart)] == [2, 3]  # the target's place


def test_objects_pushed_against_each_other_stay_two() -> None:
    apart = table(CAMERA, (0.6, 0.0, 0.04, 0.04), (0.6, 0.2, 0.03, 0.05))
    touching = table(CAMERA, (0.6, 0.108, 0.04, 0.04), (0.6, 0.2, 0.03, 0.05))
    both_moved = table(CAMERA, (0.6, 0.158, 0.04, 0.04), (0.6, 0.25, 0.03, 0.05))
    segmenter = ClusterSegmenter()
    segmenter.start(apart, pixel(apart, 0.6, 0.0))
    for image, first, second in ((touching, 0.108, 0.2), (both_moved, 0.158, 0.25)):
        found = segmenter.follow(image)
        np.testing.assert_allclose(
            [center(image, pixels)[:2] for pixels in found], [(0.6, first), (0.6, second)], atol=0.008
        )


def test_objects_that_touch_with_a_corner_come_apart_and_a_bent_one_does_not() -> None:
    map_of = np.zeros((60, 60), bool)
    map_of[10:25, 10:25] = map_of[24:40, 23:40] = True
    assert sorted(part.sum() for part in split_at_necks(map_of)) == pytest.approx([225, 272], abs=8)
    bent = np.zeros((60, 60), bool)
    bent[10:18, 10:40] = bent[10:40, 32:40] = True
    assert len(split_at_necks(bent)) == 1


@settings(deadline=None, max_examples=10)
@given(st.floats(-0.4, 0.4), st.floats(-0.03, 0.03), st.floats(-0.03, 0.03))
def test_cells_go_to_the_shape_that_they_come_from(turn: float, x: float, y: float) -> None:
    grid = np.stack(np.meshgrid(np.arange(0, 0.06, CELL), np.arange(0, 0.08, CELL)), axis=-1).reshape(-1, 2)
    shapes = [np.column_stack((grid + offset, np.full(len(grid), high))) for offset, high in ((0.0, 0.02), (0.1, 0.03))]
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    cells = np.concatenate(shapes)
    cells = np.column_stack((cells[:, :2] @ rotation.T + (x, y), cells[:, 2]))
    owners = split_by_shapes(cells, shapes).owners
    assert (owners[: len(grid)] == 0).mean() > 0.95 and (owners[len(grid) :] == 1).mean() > 0.95


def test_the_map_covers_the_table() -> None:
    assert (ORIGIN < (0.22, -0.61)).all()


def test_clusters_agree_with_the_mask_on_what_the_kinect_sees(seen_by_kinect: Scene, put: Callable) -> None:
    names = ("mug", "sugar_box", "banana", "gelatin_box")
    objects: list[ObjectParameters] = [put(name, 0.45 + 0.1 * n, -0.35 + 0.22 * n) for n, name in enumerate(names)]
    seen = seen_by_kinect.reset(objects, np.random.default_rng(0))
    assert seen.visible.tolist() == [True] * 4 + [False]
    assert seen_by_kinect.objects[0].name == "mug"  # confirmed
    by_mask = Scene(camera="kinect2", segmentation="mask")
    expected = by_mask.reset(seen_by_kinect.objects, np.random.default_rng(0))
    np.testing.assert_allclose(seen.centers[:4], expected.centers[:4], atol=0.012)
    assert [one.name for one in seen_by_kinect.objects] == [one.name for one in by_mask.objects]
    by_mask.close()


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("segmentation", SEGMENTERS)
def test_gymnasium_finds_nothing_wrong_with_any_camera_and_segmentation(camera: str, segmentation: str) -> None:
    env = PushingEnv(objects=2, camera=camera, segmentation=segmentation)
    check_env(env, skip_render_check=True)
    env.close()


PROGRAM = """
import hashlib, numpy as np
from envs.pushing import PushingEnv
env, hashed = PushingEnv(objects=3, camera="kinect2", segmentation="clusters"), hashlib.sha256()
for run in range({runs}):
    seen = [env.reset(seed=4)[0]]
    seen += [env.step(action)[0] for action in np.random.default_rng(0).uniform(-1, 1, (3, 4)).astype(np.float32)]
    hashed = hashlib.sha256()
    for one in seen:
        for name in sorted(one):
            hashed.update(one[name].tobytes())
print(hashed.hexdigest())
"""


def test_a_seed_and_actions_give_the_same_observations_again_and_in_another_process() -> None:
    hashes = []
    for runs in (1, 2):
        command = [sys.executable, "-c", PROGRAM.format(runs=runs)]
        hashes.append(subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout)
    assert hashes[0] == hashes[1]


def test_an_unknown_segmentation_gets_its_one_line() -> None:
    with pytest.raises(ValueError, match=r"^unknown segmentation 'guess': choose from mask, clusters$"):
        PushingEnv(segmentation="guess")
