"""Depth cameras by name."""

from __future__ import annotations

from collections.abc import Callable

from cavin_pyro.envs.tabletop.sensors.camera import Camera
from cavin_pyro.envs.tabletop.sensors.kinect2 import Kinect2
from cavin_pyro.envs.tabletop.sensors.sensor import DepthImage, DepthSensor, IdealSensor, Renderer, Rendering
from cavin_pyro.models.checks import check_choice

CAMERAS: dict[str, Callable[[], DepthSensor]] = {"ideal": IdealSensor, "kinect2": Kinect2}


def sensor_of(camera: str | Camera | DepthSensor) -> DepthSensor:
    """The sensor of that name, an ideal one for a camera's geometry, or the given sensor.

    Raises ValueError: unknown name.
    """
    if isinstance(camera, Camera):
        return IdealSensor(camera)
    if not isinstance(camera, str):
        return camera
    check_choice("camera", camera, CAMERAS)
    return CAMERAS[camera]()


__all__ = ["CAMERAS", "DepthImage", "DepthSensor", "IdealSensor", "Kinect2", "Renderer", "Rendering", "sensor_of"]
