"""Shapes of objects from above, taken when they stood alone, to place on later maps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from envs.segmentation.height_map import Mask
from envs.segmentation.regions import AROUND


@dataclass(frozen=True)
class Pose:
    """The position of a shape's middle on a map (row, column), in cells, and its rotation, radians."""

    row: float
    column: float
    turn: float = 0.0


@dataclass(frozen=True)
class Shape:
    """Heights of an object's cells, and its last pose.

    Attributes:
        patch: [h, w] metres above the table; 0 outside of the object. middle: (row, column) in the patch of the
            cell at `pose`. pose: the last observed one.
    """

    patch: NDArray[np.float32]
    middle: tuple[int, int]
    pose: Pose

    @property
    def area(self) -> int:
        """In cells."""
        return int((self.patch > 0.0).sum())

    def shifted(self, rows: int, columns: int) -> Shape:
        """The same shape on a map with another origin."""
        return replace(self, pose=replace(self.pose, row=self.pose.row + rows, column=self.pose.column + columns))

    def covered_cells(self, pose: Pose) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """The cells [C, 2] that the shape covers at a pose, and its heights there [C]; each takes the nearest's."""
        high, wide = self.patch.shape
        cosine, sine = np.cos(pose.turn), np.sin(pose.turn)
        corners = np.array([(0, 0), (0, wide - 1), (high - 1, 0), (high - 1, wide - 1)]) - self.middle
        moved = corners @ np.array([[cosine, sine], [-sine, cosine]]) + (pose.row, pose.column)
        lowest, highest = np.floor(moved.min(axis=0)).astype(int), np.ceil(moved.max(axis=0)).astype(int)
        rows, columns = (np.arange(low, top + 1) for low, top in zip(lowest, highest, strict=True))
        down, right = (rows - pose.row)[:, None], (columns - pose.column)[None]
        source_rows = np.rint(cosine * down + sine * right + self.middle[0]).astype(np.intp)
        source_columns = np.rint(cosine * right - sine * down + self.middle[1]).astype(np.intp)
        inside = (source_rows >= 0) & (source_rows < high) & (source_columns >= 0) & (source_columns < wide)
        heights = np.where(inside, self.patch[source_rows % high, source_columns % wide], 0.0).astype(np.float32)
        covered = np.nonzero(heights)
        return np.stack((rows[covered[0]], columns[covered[1]]), axis=-1), heights[covered]


def shape_of(region: Mask, heights: NDArray[np.float32]) -> Shape:
    """The shape of a region [I, J], not empty, of a map of heights [I, J], with its little gaps closed."""
    rows, columns = np.nonzero(region)
    first = int(rows.min()), int(columns.min())
    box = slice(first[0], int(rows.max()) + 1), slice(first[1], int(columns.max()) + 1)
    # The cell nearest to the mean lies on the object, even if that is bent.
    middle = int(((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2).argmin())
    row, column = int(rows[middle]), int(columns[middle])
    closed = ndimage.binary_closing(np.pad(region[box], 1), AROUND)[1:-1, 1:-1]
    patch = np.where(closed, heights[box], 0.0).astype(np.float32)
    return Shape(patch, (row - first[0], column - first[1]), Pose(row, column))
