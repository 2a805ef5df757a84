"""The overhead camera: geometry alone, and through the renderer."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.scene import Scene
from envs.sensors.camera import RAY_COLUMN, RAY_ROW, Camera, sample_cloud


@settings(deadline=None)
@given(
    row=st.integers(0, 211),
    column=st.integers(0, 255),
    distance=st.floats(0.3, 2.0),
    position=st.tuples(st.floats(0.4, 0.8), st.floats(-0.2, 0.2), st.floats(0.7, 1.5)),
)
def test_projecting_a_point_finds_where_its_ray_passes_through_the_pixel(
    row: int, column: int, distance: float, position: tuple[float, float, float]
) -> None:
    camera = Camera(position=position)
    depth = np.full((camera.height, camera.width), distance)
    point = camera.points(depth, np.array([row]), np.array([column]))
    assert point.shape == (1, 3)
    assert point[0, 2] == pytest.approx(position[2] - distance)
    np.testing.assert_allclose(camera.project(point), [[column + RAY_COLUMN, row + RAY_ROW]], atol=1e-6)


def test_the_images_up_is_x_and_its_left_is_y() -> None:
    camera = Camera()
    middle, up, left = camera.project(np.array([[0.6, 0.0, 0.0], [0.7, 0.0, 0.0], [0.6, 0.1, 0.0]]))
    np.testing.assert_allclose(middle, [camera.width / 2, camera.height / 2])
    assert up[1] < middle[1] and up[0] == middle[0]
    assert left[0] < middle[0] and left[1] == middle[1]


def test_a_resized_camera_sees_the_same_in_more_pixels() -> None:
    camera = Camera(position=(0.5, 0.1, 0.9))
    points = np.random.default_rng(0).uniform([0.3, -0.5, 0.0], [0.9, 0.5, 0.2], size=(20, 3))
    larger = camera.resized(2 * camera.width, 2 * camera.height)
    np.testing.assert_allclose(larger.project(points), 2 * camera.project(points))


def test_the_whole_table_is_in_view() -> None:
    camera = Camera()
    corners = camera.project(np.array([[x, y, 0.0] for x in (0.22, 0.98) for y in (-0.61, 0.61)]))
    assert (corners >= 0).all() and (corners <= [camera.width, camera.height]).all()


def test_the_bare_table_lies_at_height_zero(scene: Scene, put: Callable) -> None:
    scene.reset([put("rubiks_cube", 0.6, 0.4)], np.random.default_rng(0))
    rendering = scene.world.render(scene.camera)
    assert rendering.depth.shape == rendering.bodies.shape == (212, 256)
    rows, columns = np.mgrid[60:150:10, 100:160:10].reshape(2, -1)
    points = scene.camera.points(rendering.depth, rows, columns)
    np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-3)


@pytest.mark.parametrize("name", ["gelatin_box", "rubiks_cube", "sugar_box"])
def test_the_cloud_of_a_box_right_under_the_camera_is_centred_on_it(scene: Scene, put: Callable, name: str) -> None:
    observed = scene.reset([put(name, 0.6, 0.0)], np.random.default_rng(0))
    truth = scene.ground_truth().positions[0]
    np.testing.assert_allclose(observed.centers[0, :2], truth[:2], atol=0.004)  # the noise of 256 points
    assert abs(np.median(observed.clouds[0, :, 2]) - 2 * truth[2]) < 0.002  # the top of the box


def test_points_of_boxes_lie_neither_too_far_to_a_side_nor_too_far_ahead(scene: Scene, put: Callable) -> None:
    errors = []
    for number in range(60):
        x, y = 0.6 + 0.0007 * number, 0.0005 * number
        observed = scene.reset([put("gelatin_box", x, y)], np.random.default_rng(number))
        errors.append(observed.centers[0, :2] - scene.ground_truth().positions[0, :2])
    np.testing.assert_allclose(np.mean(errors, axis=0), 0.0, atol=0.001)


@settings(deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_a_cloud_repeats_points_only_where_there_are_too_few(present: int, count: int, seed: int) -> None:
    points = np.arange(3.0 * present).reshape(present, 3)
    cloud = sample_cloud(points, count, np.random.default_rng(seed))
    assert cloud.shape == (count, 3)
    assert {tuple(point) for point in cloud} <= {tuple(point) for point in points}
    if present >= count:
        assert len({tuple(point) for point in cloud}) == count


def test_a_cloud_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="the object is not visible"):
        sample_cloud(np.zeros((0, 3)), 4, np.random.default_rng(0))
