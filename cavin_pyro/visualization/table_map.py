"""The table as a map: a parallel projection from above, with the observed points."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from cavin_pyro.visualization.overlay import Pixels, View
from envs.scene import COLORS
from envs.workspace import TABLE_CENTER, TABLE_HIGH, TABLE_LOW

PIXELS_PER_METRE = 365.5  # that of the videos' camera, so that both views have one size
GRID = 0.25  # metres between two marks on an axis


class Map:
    """A parallel projection along z. The picture's up is +x of the table, its left +y, as in the camera's image."""

    def project(self, points: NDArray[np.floating]) -> Pixels:
        """Pixels (column, row) [..., 2] of points [..., 3] metres; heights do not matter."""
        offset = np.asarray(TABLE_CENTER) - np.asarray(points, dtype=np.float64)[..., :2]
        return PIXELS_PER_METRE * offset[..., ::-1]


def draw_clouds(panel: Axes, clouds: NDArray[np.float32], mask: NDArray[np.bool_], view: View) -> None:
    """Draw the points [M, 256, 3] metres of the objects in the mask [M], each in its object's colour."""
    for number in np.flatnonzero(mask):
        pixels = view.project(clouds[number])
        panel.scatter(pixels[:, 0], pixels[:, 1], s=1.5, color=COLORS[number], linewidths=0, zorder=1.5)


def mark_axes(panel: Axes, view: View) -> None:
    """Name x and y, in metres."""
    for axis, name in ((0, "x"), (1, "y")):
        marks = GRID * np.arange(np.ceil(TABLE_LOW[axis] / GRID), np.floor(TABLE_HIGH[axis] / GRID) + 1)
        points = np.zeros((len(marks), 3))
        points[:, axis] = marks
        places, labels = view.project(points)[:, 1 - axis], [f"{mark:g}" for mark in marks]
        if name == "x":
            panel.set_yticks(places, labels, fontsize=7)
        else:
            panel.set_xticks(places, labels, fontsize=7)
    panel.set_xlabel("y (m)", fontsize=8)
    panel.set_ylabel("x (m)", fontsize=8)
