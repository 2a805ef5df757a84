"""From an image's segmented pixels to an observation: one point cloud per object."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.envs.tabletop.segmentation import Pixels
from cavin_pyro.envs.tabletop.sensors import DepthImage
from cavin_pyro.envs.tabletop.sensors.camera import sample_cloud
from cavin_pyro.envs.tabletop.workspace import OBJECT_SLOTS, POINTS_PER_OBJECT
from cavin_pyro.models.state import State

MINIMUM_PIXELS = 8  # minimum to locate an object


@dataclass(frozen=True)
class Observation:
    """An observation of the table, padded to M objects.

    Attributes:
        clouds: [M, 256, 3] metres in the robot's base frame. centers: [M, 3] metres, the mean of all points that the
            camera sees of each object, of which a cloud has a sample.
        mask: [M] bool, True for objects observed at least once.
        visible: [M] bool, True for objects in this image; an occluded object keeps its latest cloud.
    """

    clouds: NDArray[np.float32]
    centers: NDArray[np.float32]
    mask: NDArray[np.bool_]
    visible: NDArray[np.bool_]


class LatestClouds:
    """The latest point cloud of each of an episode's objects.

    Args:
        generator: samples each cloud's points from its pixels. slots: M.
    """

    def __init__(self, generator: np.random.Generator, slots: int = OBJECT_SLOTS) -> None:
        self._generator = generator
        self._clouds = np.zeros((slots, POINTS_PER_OBJECT, 3), dtype=np.float32)
        self._centers = np.zeros((slots, 3), dtype=np.float32)
        self._mask = np.zeros(slots, dtype=np.bool_)

    def update(self, image: DepthImage, found: Sequence[Pixels]) -> Observation:
        """Update with an image and the pixels that each object has in it; the first object is the target."""
        visible = np.zeros_like(self._mask)
        for slot, (rows, columns) in enumerate(found):
            if len(rows) >= MINIMUM_PIXELS:
                points = image.camera.points(image.depth, rows, columns)
                self._clouds[slot] = sample_cloud(points, POINTS_PER_OBJECT, self._generator)
                # Of all points: the mean of the sample would be off by 2 mm, more than a push's outcome forgives.
                self._centers[slot] = points.mean(0)
                visible[slot] = True
        self._mask |= visible
        return Observation(self._clouds.copy(), self._centers.copy(), self._mask.copy(), visible)


@torch.inference_mode()
def state_of(observation: Mapping[str, NDArray[Any]], geometry: Callable[[Tensor], Tensor]) -> State:
    """The state `[M]` of an observation, without needless padding.

    Args:
        observation: `centers`, `clouds` and `mask` of `Observation`, [M, ...]. geometry: on the CPU.

    Raises:
        ValueError: no object, or numbers of one that are not finite.
    """
    real = np.flatnonzero(observation["mask"])
    for name in ("clouds", "centers"):
        if not (observation[name][real].size and np.isfinite(observation[name][real]).all()):
            raise ValueError(f"{name} of an observation must be finite numbers of at least one object")
    objects = int(real.max()) + 1
    centers = torch.from_numpy(observation["centers"][:objects])
    clouds = torch.from_numpy(observation["clouds"][:objects]) - centers[:, None]
    mask = torch.from_numpy(observation["mask"][:objects].astype(np.bool_))
    return State(centers, geometry(clouds), mask)
