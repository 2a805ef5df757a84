"""The remaining distance to the goal along allowed places: a distance field, computed once and interpolated anywhere.

A goal may lie beyond a planner's horizon. The straight distance is then misleading: on a U-shaped bridge the end is
near the start. The length of the shortest path that breaks no rule is not.
"""

from __future__ import annotations

import copy

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.workspace import TABLE_HIGH, TABLE_LOW, TILE_SIDE

SPACING = TILE_SIDE / 15  # metres between the grid's points; no point lies on a tile's border
_COUNT = tuple(round((high - low) / SPACING) for low, high in zip(TABLE_LOW, TABLE_HIGH, strict=True))
_FIRST = tuple(low + SPACING / 2 for low in TABLE_LOW)


class DistanceField:
    """Length of the shortest path from each point of the table to the nearest goal point, along allowed points.

    From a point that is not allowed, or without such a path, it is the length of the shortest path that also crosses
    forbidden places. Between the points of the grid it is bilinear. Without a goal point it is 0 everywhere.

    Args:
        allowed, goal: which points of the `grid()` are, [rows, columns] bool.

    Attributes:
        longest: metres, an upper bound on all lengths.
    """

    def __init__(self, allowed: Tensor, goal: Tensor) -> None:
        arrived = goal.numpy()
        lengths = np.zeros(_COUNT)
        if arrived.any():
            # The border of the goal lies half a step before its first point.
            start = np.where(arrived, -SPACING / 2, np.inf)
            within = _eikonal(start, allowed.numpy() | arrived)
            lengths = _eikonal(within, np.ones_like(arrived)).clip(min=0.0)
        self.longest = float(lengths.max())
        # The four corners of each cell side by side, so that one row holds all that a point needs.
        corners = [lengths[i : _COUNT[0] - 1 + i, j : _COUNT[1] - 1 + j] for i in (0, 1) for j in (0, 1)]
        self._cells = torch.from_numpy(np.stack(corners, -1).reshape(-1, 4).astype(np.float32))
        self._first = torch.tensor(_FIRST)
        self._last = torch.tensor([count - 1.001 for count in _COUNT])  # within the last cell

    def to(self, device: torch.device) -> DistanceField:
        """The same field with its numbers on a device; points elsewhere cost a copy in every call."""
        moved = copy.copy(self)
        moved._cells, moved._first, moved._last = (part.to(device) for part in (self._cells, self._first, self._last))
        return moved

    def __call__(self, points: Tensor) -> Tensor:
        """Remaining metres from points [..., 2]: [...]; off the table, those of the nearest point on it."""
        first, last = self._first.to(points), self._last.to(points)
        places = ((points - first) / SPACING).nan_to_num(0.0).clamp(min=0.0).minimum(last)
        corner = places.floor()
        part = places - corner
        cell = (corner[..., 0] * (_COUNT[1] - 1) + corner[..., 1]).long()
        values = self._cells.to(points).index_select(0, cell.flatten()).reshape(*cell.shape, 4)
        along_x = torch.lerp(values[..., :2], values[..., 2:], part[..., :1])
        return torch.lerp(along_x[..., 0], along_x[..., 1], part[..., 1])


def grid() -> Tensor:
    """The points [rows, columns, 2] metres for which lengths are computed."""
    axes = [
        first + SPACING * torch.arange(count, dtype=torch.float64) for first, count in zip(_FIRST, _COUNT, strict=True)
    ]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)


def _eikonal(lengths: NDArray[np.float64], allowed: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Lengths of the shortest paths over allowed points, by Godunov's upwind scheme.

    Paths begin at the points with a finite length, which keep it.
    """
    known = np.isfinite(lengths)
    padded = np.full([count + 2 for count in lengths.shape], np.inf)
    inner = padded[1:-1, 1:-1]
    inner[...] = lengths
    moving = allowed & ~known
    while True:
        a = np.minimum(padded[:-2, 1:-1], padded[2:, 1:-1])
        b = np.minimum(padded[1:-1, :-2], padded[1:-1, 2:])
        low = np.minimum(a, b)
        with np.errstate(invalid="ignore"):
            apart = np.abs(a - b)  # NaN where neither neighbour is known
        near = apart < SPACING
        both = 0.5 * (a + b + np.sqrt(2 * SPACING**2 - np.where(near, apart, 0.0) ** 2))
        new = np.where(moving, np.minimum(np.where(near, both, low + SPACING), inner), inner)
        if np.array_equal(new, inner):
            return new
        inner[...] = new
