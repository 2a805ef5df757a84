"""Objects found in depth images, with and without the simulator's help."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavin_pyro.envs.tabletop.objects.sampling import ObjectParameters
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.envs.tabletop.segmentation import ClusterSegmenter, MaskSegmenter
from cavin_pyro.envs.tabletop.segmentation.height_map import fit_table, split_at_necks
from cavin_pyro.envs.tabletop.segmentation.registration import explain, shape_of
from cavin_pyro.envs.tabletop.sensors import DepthImage
from cavin_pyro.envs.tabletop.sensors.camera import Camera

CAMERA = Camera(256, 212, rotation=(0.02, -0.02, 0.01))


def table(camera: Camera = CAMERA, *boxes: tuple[float, float, float, float], height: float = 0.05) -> DepthImage:
    """A table observed without noise, with flat-topped boxes (x, y, half x, half y) on it, metres."""
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


def test_the_mask_gives_each_object_its_own_measured_pixels_in_order() -> None:
    two, one = np.array([[0, 0, 1], [0, 1, 1]], bool), np.array([[0, 0, 0], [1, 0, 0]], bool)
    depth = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    first, second, none = MaskSegmenter(lambda: [two, one, np.zeros_like(one)]).start(DepthImage(depth, CAMERA), None)
    assert list(zip(*first, strict=True)) == [(1, 1), (1, 2)]
    assert list(zip(*second, strict=True)) == [(1, 0)]
    assert len(none[0]) == 0


@settings(deadline=None, max_examples=20)
@given(st.tuples(*[st.floats(-0.03, 0.03)] * 3), st.tuples(*[st.floats(-0.04, 0.04)] * 3), st.floats(-0.01, 0.01))
def test_the_table_is_found_though_the_cameras_pose_is_not_quite_known(
    rotation: tuple, shift: tuple, error: float
) -> None:
    position = tuple(np.add((0.6, 0.0, 1.0), shift))
    image = table(Camera(256, 212, position, rotation), (0.6, 0.0, 0.1, 0.1), (0.5, 0.4, 0.05, 0.1))
    believed = DepthImage(image.depth, Camera(256, 212, (position[0], position[1], position[2] + error), rotation))
    plane = fit_table(believed)
    assert 1.0 / np.linalg.norm(plane) == pytest.approx(position[2], abs=1e-3)  # the camera's true height


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


def test_a_handle_beside_a_body_is_part_of_it_and_a_like_thing_alone_is_an_object() -> None:
    body, handle = (0.6, 0.1, 0.04, 0.04), (0.6, 0.156, 0.03, 0.01)
    together, apart = table(CAMERA, body, handle), table(CAMERA, body, (0.6, 0.3, 0.03, 0.01))
    assert [len(ClusterSegmenter().start(image, None)) for image in (together, apart)] == [2, 3]  # the target's place


def test_objects_that_touch_with_a_corner_come_apart_and_a_bent_one_does_not() -> None:
    map_of = np.zeros((60, 60), bool)
    map_of[10:25, 10:25] = map_of[24:40, 23:40] = True
    assert sorted(part.sum() for part in split_at_necks(map_of)) == pytest.approx([225, 272], abs=8)
    bent = np.zeros((60, 60), bool)
    bent[10:18, 10:40] = bent[10:40, 32:40] = True
    assert len(split_at_necks(bent)) == 1


def test_three_in_a_row_that_touch_and_are_pushed_on_keep_their_places_until_they_part() -> None:
    sizes, row = ((0.03, 0.03), (0.05, 0.03), (0.04, 0.02)), np.array([-0.062, 0.0, 0.052])
    apart = table(CAMERA, *[(0.6, y, *size) for y, size in zip((-0.2, 0.0, 0.2), sizes, strict=True)])
    segmenter = ClusterSegmenter()
    first = [center(apart, pixels)[1] for pixels in segmenter.start(apart, pixel(apart, 0.6, 0.0))]
    order = np.argsort(first)
    for x in (0.0, 0.03, 0.06):
        pushed = table(CAMERA, *[(0.6 + x, y + x / 3, *size) for y, size in zip(row, sizes, strict=True)])
        ys = np.array([center(pushed, pixels)[1] for pixels in segmenter.follow(pushed)])
        np.testing.assert_allclose(ys[order], row + x / 3, atol=0.008)
    ys = np.array([center(apart, pixels)[1] for pixels in segmenter.follow(apart)])
    np.testing.assert_allclose(ys, first, atol=0.004)


def boxes_on_map(*boxes: tuple[float, float, float, float, float, float]) -> list[np.ndarray]:
    """Maps of heights, each of one box (row, column, turn, half height, half width in cells, metres high)."""
    rows, columns = np.indices((80, 80))
    maps = []
    for row, column, turn, high, wide, tall in boxes:
        down = np.cos(turn) * (rows - row) + np.sin(turn) * (columns - column)
        right = np.cos(turn) * (columns - column) - np.sin(turn) * (rows - row)
        maps.append(np.where((np.abs(down) <= high) & (np.abs(right) <= wide), tall, 0.0).astype(np.float32))
    return maps


SIDES = ((6.0, 9.0, 0.045), (5.0, 5.0, 0.07), (4.0, 10.0, 0.02))  # cells, metres


@settings(deadline=None, max_examples=4)
@given(st.floats(-0.3, 0.3), st.integers(-6, 6), st.integers(-6, 6), st.permutations(range(3)))
def test_cells_go_to_the_shape_that_they_come_from(turn: float, down: int, right: int, order: list[int]) -> None:
    before = [one[0] for one in (boxes_on_map((20 * n + 20, 40, 0.0, *sides)) for n, sides in enumerate(SIDES))]
    shapes = [shape_of(one > 0, one) for one in before]
    places = np.cumsum([0.0, *[SIDES[a][0] + SIDES[b][0] + 1 for a, b in pairwise(order)]])
    after = np.zeros((3, 80, 80), np.float32)
    for n, place in zip(order, places, strict=True):  # in a row, each against the next, all turned
        along = place - places.mean()
        (after[n],) = boxes_on_map(
            (40 + down + along * np.cos(turn), 40 + right + along * np.sin(turn), turn, *SIDES[n])
        )
    owners = explain(after.max(axis=0), shapes, ()).owners()
    for n in range(3):
        assert (owners[after[n] > 0] == n).mean() > 0.85


def test_clusters_agree_with_the_mask_on_what_the_kinect_sees(put: Callable) -> None:
    seen_by_kinect = Scene(camera="kinect2", segmentation="clusters")
    names = ("mug", "sugar_box", "banana", "gelatin_box")
    objects: list[ObjectParameters] = [put(name, 0.45 + 0.1 * n, -0.35 + 0.22 * n) for n, name in enumerate(names)]
    observed = seen_by_kinect.reset(objects, np.random.default_rng(0))
    assert observed.visible.tolist() == [True] * 4 + [False]
    assert seen_by_kinect.objects[0].name == "mug"  # confirmed
    by_mask = Scene(camera="kinect2", segmentation="mask")
    expected = by_mask.reset(seen_by_kinect.objects, np.random.default_rng(0))
    np.testing.assert_allclose(observed.centers[:4], expected.centers[:4], atol=0.012)
    assert [one.name for one in seen_by_kinect.objects] == [one.name for one in by_mask.objects]
    for one in (by_mask, seen_by_kinect):
        one.close()
