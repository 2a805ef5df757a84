"""What a depth sensor is to the scene, and the sensor that makes no error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from envs.sensors.camera import Camera


@dataclass(frozen=True)
class DepthImage:
    """All that a program gets from a depth camera, in the simulator as on a real robot.

    Attributes:
        depth: [height, width] metres along the optical axis; 0 where there is no measurement.
        camera: where the program believes the camera to be.
    """

    depth: NDArray[np.floating]
    camera: Camera


@dataclass(frozen=True)
class Rendering:
    """What a camera without any error would see.

    Attributes:
        depth: [height, width] metres along the optical axis.
        bodies: [height, width] body number per pixel, -1 where there is none.
        color: [height, width, 3] uint8.
    """

    depth: NDArray[np.float64]
    bodies: NDArray[np.int64]
    color: NDArray[np.uint8]


class Renderer(Protocol):
    """A renderer: `envs.physics.PhysicsWorld.render`."""

    def __call__(self, camera: Camera, *, table: bool = True) -> Rendering:
        """What `camera` sees, with or without the table."""
        ...


class DepthSensor(Protocol):
    """A depth camera as mounted: it may stand a little elsewhere in every episode, and it may err."""

    @property
    def nominal(self) -> Camera:
        """Where the camera was meant to be mounted; pictures for people are taken from there."""
        ...

    def reset(self, generator: np.random.Generator) -> None:
        """Begin an episode, whose noise is all sampled from `generator`."""
        ...

    def capture(self, render: Renderer) -> tuple[DepthImage, NDArray[np.int64]]:
        """Take an image; beside it the simulator's body numbers [height, width], which no sensor has."""
        ...


class IdealSensor:
    """A camera that stands where it should and measures without any error.

    Args:
        camera: its pose and resolution.
    """

    def __init__(self, camera: Camera | None = None) -> None:
        self.nominal = camera or Camera()

    def reset(self, generator: np.random.Generator) -> None:
        """Nothing is random here."""

    def capture(self, render: Renderer) -> tuple[DepthImage, NDArray[np.int64]]:
        """Take an image."""
        rendering = render(self.nominal)
        return DepthImage(rendering.depth, self.nominal), rendering.bodies


SensorMaker = Callable[[], DepthSensor]
