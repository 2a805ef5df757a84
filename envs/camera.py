"""The overhead depth camera: its geometry, and the way from a depth image back to points on the table.

Pinhole model with square pixels; the optical axis looks straight down unless the pose says otherwise.
Source: the published implementation (Kinect2, 512 by 424 pixels); here half of each side by default, which shows
a 57 mm cube with about a hundred pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

KINECT2_FOCAL_LENGTH = 365.5  # pixels at a width of 512 pixels
KINECT2_WIDTH = 512  # pixels
NEAR, FAR = 0.2, 3.0  # metres; the clipping planes of the renderer
# Where in a pixel the ray of PyBullet's software renderer passes, in pixels from the pixel's upper left corner
# (column, row): not through its middle. Measured on boxes whose poses are known, tests/envs/test_camera.py.
RAY_COLUMN, RAY_ROW = 0.0, 1.0


@dataclass(frozen=True)
class Camera:
    """A pinhole camera above the table.

    Attributes:
        width, height: pixels. position: (x, y, z) metres. The image's up is +x of the table, its left +y.
    """

    width: int = 256
    height: int = 212
    position: tuple[float, float, float] = (0.60, 0.0, 1.0)

    @property
    def focal_length(self) -> float:
        """Pixels; the field of view is the Kinect2's whatever the resolution."""
        return KINECT2_FOCAL_LENGTH * self.width / KINECT2_WIDTH

    def resized(self, width: int, height: int) -> Camera:
        """The same view with another number of pixels."""
        return Camera(width, height, self.position)

    def points(
        self, depth: NDArray[np.float64], rows: NDArray[np.intp], columns: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Points in the robot's base frame behind chosen pixels.

        Args:
            depth: [height, width] metres along the optical axis. rows, columns: [P] pixel indices.

        Returns:
            [P, 3] metres.
        """
        distance = depth[rows, columns]
        right = (columns + RAY_COLUMN - self.width / 2) / self.focal_length * distance
        down = (rows + RAY_ROW - self.height / 2) / self.focal_length * distance
        x, y, z = self.position
        return np.stack([x - down, y - right, z - distance], axis=-1)

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Pixel coordinates (column, row) [..., 2] of points [..., 3] metres; (0, 0) is the upper left corner."""
        points = np.asarray(points, dtype=np.float64)
        x, y, z = self.position
        distance = z - points[..., 2]
        column = (y - points[..., 1]) / distance * self.focal_length + self.width / 2
        row = (x - points[..., 0]) / distance * self.focal_length + self.height / 2
        return np.stack([column, row], axis=-1)


def sample_cloud(points: NDArray[np.float64], count: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Draw `count` of the points [P, 3], without replacement where there are enough.

    Raises:
        ValueError: there is no point to draw from.
    """
    if len(points) == 0:
        raise ValueError("no point to draw a cloud from: the object is not visible")
    return points[generator.choice(len(points), size=count, replace=len(points) < count)]
