"""A depth camera's geometry: from pixels to points in the robot's base frame, and back, for any pose.

Pinhole model without lens distortion. Source: the published implementation (Kinect2, 512 by 424 pixels); here half of
each side by default, with about a hundred pixels for a 57 mm cube.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

KINECT2_FOCAL_LENGTH = 365.5  # pixels at a width of 512 pixels
KINECT2_WIDTH, KINECT2_HEIGHT = 512, 424  # pixels
NEAR, FAR = 0.2, 3.0  # metres; the clipping planes of the renderer
# Where in a pixel the ray of PyBullet's software renderer passes, in pixels from the pixel's upper left corner
# (column, row): not through its middle. Measured on boxes whose poses are known, tests/envs/test_camera.py.
RAY_COLUMN, RAY_ROW = 0.0, 1.0
# The axes of an image in the base frame, where the camera looks straight down: right is -y, down is -x, ahead is -z.
_OVERHEAD = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera above the table.

    Attributes:
        width, height: pixels. position: (x, y, z) metres.
        rotation: from looking straight down, a rotation vector in the base frame, radians. Without rotation, the
            image's up is +x of the table and its left +y.
        intrinsics_offset: added to the Kinect2's (focal length along a row, along a column, principal
            column, principal row), in pixels at a width of 512.
    """

    width: int = 256
    height: int = 212
    position: tuple[float, float, float] = (0.60, 0.0, 1.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    intrinsics_offset: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @property
    def focal_length(self) -> float:
        """Pixels, without the offsets; the field of view is the Kinect2's at every resolution."""
        return KINECT2_FOCAL_LENGTH * self.width / KINECT2_WIDTH

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """Focal length along a row and along a column, principal column and row, in pixels of this image."""
        along_row, along_column, column, row = (
            offset * self.width / KINECT2_WIDTH for offset in self.intrinsics_offset
        )
        focal = self.focal_length
        return focal + along_row, focal + along_column, self.width / 2 + column, self.height / 2 + row

    @property
    def axes(self) -> NDArray[np.float64]:
        """The image's right, down and ahead as rows [3, 3], unit vectors in the base frame."""
        return _OVERHEAD @ Rotation.from_rotvec(self.rotation).as_matrix().T

    def rays(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float64]:
        """Rays of pixels, in the image's axes: [P, 3] (right, down, 1), metres at a distance of one metre.

        `rows`, `columns`: [P] pixel indices.
        """
        along_row, along_column, column, row = self.intrinsics
        right = (columns + RAY_COLUMN - column) / along_row
        down = (rows + RAY_ROW - row) / along_column
        return np.stack([right, down, np.ones_like(right)], axis=-1)

    def points(
        self, depth: NDArray[np.floating], rows: NDArray[np.intp], columns: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Points in the robot's base frame at chosen pixels.

        `depth`: [height, width] metres along the optical axis. `rows`, `columns`: [P] pixel indices. Returns [P, 3]
        metres.
        """
        return np.array(self.position) + (self.rays(rows, columns) * depth[rows, columns][:, None]) @ self.axes

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Pixel coordinates (column, row) [..., 2] of points [..., 3] metres; (0, 0) is the upper left corner."""
        offsets = (np.asarray(points, dtype=np.float64) - np.array(self.position)) @ self.axes.T
        along_row, along_column, column, row = self.intrinsics
        return offsets[..., :2] / offsets[..., 2:] * (along_row, along_column) + (column, row)


def sample_cloud(points: NDArray[np.float64], count: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Sample `count` of the points [P, 3], each as often as any other or once more.

    Raises ValueError: there is no point to sample from.
    """
    if len(points) == 0:
        raise ValueError("no point to sample a cloud from: the object is not visible")
    whole, rest = divmod(count, len(points))
    once_more = generator.choice(len(points), size=rest, replace=False)
    return points[np.concatenate([np.tile(np.arange(len(points)), whole), once_more])]
