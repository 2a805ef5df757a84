"""Cameras: their geometry, alone and through the renderer, and the Kinect v2's errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavin_pyro.envs.tabletop.physics.world import _render
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.envs.tabletop.sensors import Kinect2
from cavin_pyro.envs.tabletop.sensors.camera import RAY_COLUMN, RAY_ROW, Camera
from cavin_pyro.envs.tabletop.sensors.kinect2 import CALIBRATION, NOMINAL, RESOLUTION, VIEWPOINT, Perturbation


def test_points_of_boxes_lie_neither_too_far_to_a_side_nor_too_far_ahead(scene: Scene, put: Callable) -> None:
    errors = []
    for number in range(20):
        x, y = 0.6 + 0.0021 * number, 0.0015 * number
        observed = scene.reset([put("gelatin_box", x, y)], np.random.default_rng(number))
        errors.append(observed.centers[0, :2] - scene.ground_truth().positions[0, :2])
    np.testing.assert_allclose(np.mean(errors, axis=0), 0.0, atol=0.001)


coordinate = st.floats(-1.0, 1.0)
cameras = st.builds(
    Camera,
    st.integers(64, 512),
    st.integers(64, 424),
    st.tuples(coordinate, coordinate, st.floats(0.4, 2.0)),
    st.tuples(coordinate, coordinate, coordinate),
    st.tuples(*[st.floats(-20.0, 20.0)] * 4),
)


@settings(deadline=None, max_examples=30)
@given(cameras, st.data())
def test_a_point_behind_a_pixel_is_projected_back_into_it_whatever_the_pose(
    camera: Camera, data: st.DataObject
) -> None:
    row = data.draw(st.integers(0, camera.height - 1))
    column = data.draw(st.integers(0, camera.width - 1))
    depth = np.full((camera.height, camera.width), data.draw(st.floats(0.3, 3.0)))
    point = camera.points(depth, np.array([row]), np.array([column]))
    np.testing.assert_allclose(camera.project(point), [[column + RAY_COLUMN, row + RAY_ROW]], atol=1e-6)
    along_axis = (point - np.array(camera.position)) @ camera.axes[2]
    np.testing.assert_allclose(along_axis, depth[row, column], atol=1e-9)


def test_the_renderer_draws_what_the_geometry_says_of_a_turned_and_shifted_camera(scene: Scene, put: Callable) -> None:
    scene.reset([put("rubiks_cube", 0.6, 0.1)], np.random.default_rng(0))
    camera = Camera(512, 424, (0.63, -0.04, 1.03), (0.02, -0.025, 0.02), (12.0, -9.0, -14.0, 15.0))
    rendering = scene.world.render(camera)
    points = camera.points(rendering.depth, *np.nonzero(rendering.bodies == scene.bodies[0]))
    truth = scene.ground_truth().positions[0]
    top = points[points[:, 2] > 2 * truth[2] - 0.001]
    assert len(top) > 0.7 * len(points)  # the rest is a side of the cube
    np.testing.assert_allclose(top.mean(axis=0), (truth[0], truth[1], 2 * truth[2]), atol=0.002)


def test_objects_before_a_table_rendered_once_are_the_image_of_all(scene: Scene, put: Callable) -> None:
    scene.reset([put("mug", 0.5, 0.1), put("banana", 0.7, -0.1)], np.random.default_rng(0))
    for camera in (Camera(), Camera(400, 300, (0.2, 0.3, 0.9), (0.5, 0.3, 0.1))):
        whole, direct = scene.world.render(camera), _render(scene.world.client, camera)
        for name in ("depth", "bodies", "color"):
            np.testing.assert_array_equal(getattr(whole, name), getattr(direct, name))


def test_the_kinect_measures_a_bare_table_as_its_noise_model_says(scene: Scene, put: Callable) -> None:
    scene.reset([put("rubiks_cube", 0.3, 0.5)], np.random.default_rng(0))
    sensor = Kinect2(viewpoint=Perturbation(0, 0, 0), calibration=Perturbation(0, 0, 0))
    sensor.reset(np.random.default_rng(0))
    image, _ = sensor.capture(scene.world.render)
    assert image.depth.shape == (424, 512)
    middle = image.depth[180:240, 220:290]
    assert 0 < (middle == 0).mean() < 0.01
    assert np.median(middle) == pytest.approx(1.0, abs=5e-4)
    assert middle[middle > 0].std() == pytest.approx(0.0013, rel=0.1)
    np.testing.assert_allclose(image.depth / RESOLUTION, np.rint(image.depth / RESOLUTION), atol=1e-3)
    assert not image.depth[:10].any()  # there is nothing beside the table


def test_measurements_are_missing_and_mixed_at_the_edges_of_objects(scene: Scene, put: Callable) -> None:
    scene.reset([put("tomato_soup_can", 0.6, 0.0)], np.random.default_rng(0))
    sensor = Kinect2()
    sensor.reset(np.random.default_rng(0))
    image, bodies = sensor.capture(scene.world.render)
    can = bodies == scene.bodies[0]
    outline = can & ~(np.roll(can, 1, 0) & np.roll(can, -1, 0) & np.roll(can, 1, 1) & np.roll(can, -1, 1))
    assert (image.depth[outline] == 0).mean() > 0.2
    assert (image.depth[can & ~outline] == 0).mean() < 0.2


def test_the_kinect_stands_elsewhere_in_every_episode_and_is_believed_to_stand_near_there() -> None:
    sensor, actual = Kinect2(replace(NOMINAL, width=64, height=53)), []
    for seed in range(12):
        sensor.reset(np.random.default_rng(seed))
        actual.append(sensor.actual.position)
        for camera, other, bounds in (
            (sensor.actual, sensor.nominal, VIEWPOINT),
            (sensor.believed, sensor.actual, CALIBRATION),
        ):
            assert np.abs(np.subtract(camera.position, other.position)).max() <= bounds.translation
            assert np.abs(np.subtract(camera.intrinsics, other.intrinsics)).max() <= bounds.intrinsics
            assert np.abs(np.subtract(camera.rotation, other.rotation)).max() <= 1.1 * bounds.rotation
    np.testing.assert_allclose(np.ptp(actual, axis=0), 2 * VIEWPOINT.translation, rtol=0.5)
