"""From an image's segmented pixels to an observation: one point cloud per object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.envs.tabletop.segmentation import Pixels
from cavin_pyro.envs.tabletop.sensors import DepthImage
from cavin_pyro.envs.tabletop.sensors.camera import sample_cloud
from cavin_pyro.envs.tabletop.workspace import OBJECT_SLOTS, POINTS_PER_OBJECT, REACH_HIGH, REACH_LOW

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

    `generator`: samples each cloud's points from its pixels. `slots`: M.
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


class ObservedPoints(NamedTuple):
    """Points of the objects that the camera sees, and the box that normalised starts of pushes span."""

    points: Tensor  # [B, P, 2] metres; infinite for no point
    low: Tensor  # [B, 2] metres, the start -1
    high: Tensor  # [B, 2] metres, the start 1

    @classmethod
    def of(cls, observation: Mapping[str, NDArray[Any]]) -> ObservedPoints:
        """Those of real objects, object after object, in a batch of one."""
        real = observation["mask"].astype(np.bool_)
        points = torch.from_numpy(observation["clouds"][real][..., :2].reshape(1, -1, 2))
        return cls(points, *(torch.tensor([corner], dtype=points.dtype) for corner in (REACH_LOW, REACH_HIGH)))

    def blocked(self, pushes: Tensor, distance: float) -> Tensor:
        """`[B, N]` bool: `pushes: [B, N, 4]` that start nearer than `distance` metres to a point."""
        low, high = self.low.unsqueeze(1), self.high.unsqueeze(1)
        starts = low + (pushes[..., :2].clamp(-1.0, 1.0) + 1.0) / 2.0 * (high - low)
        if self.points.shape[1] == 0:
            return torch.zeros_like(starts[..., 0], dtype=torch.bool)
        # Not by matrix products, in which an infinite point makes all distances NaN.
        apart = torch.cdist(starts, self.points, compute_mode="donot_use_mm_for_euclid_dist")
        return apart.amin(-1) < distance
