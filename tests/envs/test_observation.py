"""What is seen of the objects: a cloud and a centre for each, from one depth image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from envs.objects.sampling import WHOLE_TABLE, ObjectRanges
from envs.scene import Scene
from envs.sensors import IdealSensor
from envs.sensors.camera import Camera
from envs.workspace import OBJECT_SLOTS, POINTS_PER_OBJECT

RANGES = ObjectRanges(clearance=0.12)


def test_an_observation_has_a_cloud_per_object_and_zeros_for_padding(scene: Scene, put: Callable) -> None:
    observed = scene.reset([put("mug", 0.5, 0.2), put("banana", 0.6, -0.2)], np.random.default_rng(0))
    assert observed.clouds.shape == (OBJECT_SLOTS, POINTS_PER_OBJECT, 3)
    assert observed.clouds.dtype == observed.centers.dtype == np.float32
    np.testing.assert_allclose(observed.centers, observed.clouds.mean(axis=1), atol=2e-3)  # of a sample of the points
    assert not observed.clouds[2:].any() and not observed.centers[2:].any()
    poses = scene.ground_truth().positions
    np.testing.assert_allclose(observed.centers[:2, :2], poses[:, :2], atol=0.02)  # half of an object is hidden


def test_a_centre_is_the_mean_of_all_visible_points_so_objects_that_lie_still_are_seen_so(
    scene: Scene, put: Callable
) -> None:
    observed = scene.reset([put("mug", 0.5, 0.2), put("sugar_box", 0.6, -0.2)], np.random.default_rng(0))
    image = scene.capture()
    for center, mask in zip(observed.centers, scene.true_masks(), strict=False):
        points = image.camera.points(image.depth, *np.nonzero(mask))
        np.testing.assert_allclose(center, points.mean(0), atol=1e-6)
    again = scene.observe()
    assert np.array_equal(again.centers, observed.centers)
    assert not np.array_equal(again.clouds, observed.clouds)  # which are other samples


def test_an_object_out_of_view_keeps_its_last_cloud(put: Callable) -> None:
    scene = Scene()
    first = scene.reset([put("mug", 0.6, 0.3), put("rubiks_cube", 0.6, -0.3)], np.random.default_rng(0))
    scene.sensor = IdealSensor(Camera(position=(0.6, -0.3, 0.4)))
    second = scene.observe()
    assert second.visible.tolist() == [False, True, False, False, False]
    assert second.mask.tolist() == first.mask.tolist() == [True, True, False, False, False]
    np.testing.assert_array_equal(second.clouds[0], first.clouds[0])
    assert not np.array_equal(second.clouds[1], first.clouds[1])
    scene.close()


def test_an_object_never_observed_is_not_in_the_mask(put: Callable, push: Callable) -> None:
    scene = Scene(camera=Camera(position=(0.6, -0.3, 0.4)))
    observed = scene.reset([put("mug", 0.6, 0.3), put("rubiks_cube", 0.6, -0.3)], np.random.default_rng(0))
    assert observed.mask.tolist() == observed.visible.tolist() == [False, True, False, False, False]
    assert not observed.clouds[0].any()
    report = scene.push(push(0.6, 0.5, 0.0, -0.1))
    assert report.moved.shape == (2,)
    scene.close()


def test_a_later_capture_does_not_change_an_earlier_observation(scene: Scene, put: Callable, push: Callable) -> None:
    observed = scene.reset([put("mug", 0.55, 0.0)], np.random.default_rng(0))
    clouds, mask = observed.clouds.copy(), observed.mask.copy()
    scene.push(push(0.45, 0.0, 0.1, 0.0))
    scene.observe()
    np.testing.assert_array_equal(observed.clouds, clouds)
    np.testing.assert_array_equal(observed.mask, mask)


@pytest.mark.parametrize("seed", [10000, 10001])
def test_clusters_find_ten_objects(seed: int) -> None:
    crowded = Scene(segmentation="clusters", slots=10)
    observed = crowded.sample([WHOLE_TABLE] * 10, RANGES, np.random.default_rng(seed))
    offset = np.linalg.norm(observed.centers[:, None, :2] - crowded.ground_truth().positions[None, :, :2], axis=-1)
    assert offset.min(axis=1).max() < 0.04
    crowded.close()
