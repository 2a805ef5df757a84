"""The interface of depth sensors, and a sensor without errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.sensors.camera import Camera


@dataclass(frozen=True)
class DepthImage:
    """The image of a depth camera, simulated or real.

    `depth`: [height, width] metres along the optical axis; 0 where there is no measurement. `camera`: the assumed
    camera.
    """

    depth: NDArray[np.floating]
    camera: Camera


@dataclass(frozen=True)
class Rendering:
    """The image of a camera without errors.

    Attributes:
        depth: [height, width] metres along the optical axis.
        bodies: [height, width] body number per pixel, -1 where there is none.
        color: [height, width, 3] uint8.
    """

    depth: NDArray[np.float64]
    bodies: NDArray[np.int64]
    color: NDArray[np.uint8]


class Renderer(Protocol):
    """A renderer: `cavin_pyro.envs.tabletop.physics.PhysicsWorld.render`."""

    def __call__(self, camera: Camera, *, table: bool = True) -> Rendering:
        """Render the view of `camera`, with or without the table."""


@runtime_checkable
class DepthSensor(Protocol):
    """A mounted depth camera; its pose may vary between episodes, and it may have noise."""

    @property
    def nominal(self) -> Camera:
        """The nominal camera, in whose view no robot may stand."""

    def reset(self, generator: np.random.Generator) -> None:
        """Begin an episode, whose noise is all sampled from `generator`."""

    def capture(self, render: Renderer) -> tuple[DepthImage, NDArray[np.int64]]:
        """Take an image; also returns the simulator's body numbers [height, width], which no real sensor has."""


class IdealSensor:
    """A camera at its nominal pose, without errors; `camera`: its pose and resolution."""

    def __init__(self, camera: Camera | None = None) -> None:
        self.nominal = camera or Camera()

    def reset(self, generator: np.random.Generator) -> None:
        """Nothing is random."""

    def capture(self, render: Renderer) -> tuple[DepthImage, NDArray[np.int64]]:
        rendering = render(self.nominal)
        return DepthImage(rendering.depth, self.nominal), rendering.bodies
