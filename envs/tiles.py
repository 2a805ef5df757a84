"""Distances to unions of tiles, as pure functions of tensors with any leading dimensions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from envs.layouts import Tile
from envs.workspace import TABLE_HIGH, TABLE_LOW, TILE_SIDE, tile_center


class TileSet:
    """A union of tiles, to which points have an exact signed distance.

    Args:
        tiles: at least one tile; neighbours melt into one shape.
    """

    def __init__(self, tiles: Iterable[Tile]) -> None:
        self.tiles = tuple(tiles)
        self.centers = _tensor([tile_center(tile) for tile in self.tiles]).reshape(-1, 2)
        # Neighbours compute their common border from the same half index, so that rounding leaves no gap.
        rows = [
            (tile_center((i - 0.5, first - 0.5)), tile_center((i + 0.5, last + 0.5)))
            for i, first, last in _rows(self.tiles)
        ]
        self._rows, self._edges = _Rectangles(rows), _Rectangles(_outline(set(self.tiles)))

    def contains(self, points: Tensor) -> Tensor:
        """Whether points [..., 2] metres lie in the union, its border included: [...] bool."""

        def depth(x: Tensor, y: Tensor, low: Any, high: Any) -> Tensor:
            across, along = torch.minimum(x - low[0], high[0] - x), torch.minimum(y - low[1], high[1] - y)
            return torch.minimum(across, along)

        # Not `any` of four comparisons: native code takes many points at once where numbers are compared last.
        return self._rows.of_each(depth, points, torch.amax, torch.maximum) >= 0.0

    def signed_distance(self, points: Tensor) -> Tensor:
        """Metres from points [..., 2] to the union's outline, negative inside: [...]."""

        def squared(x: Tensor, y: Tensor, low: Any, high: Any) -> Tensor:
            # One axis at a time: edges innermost is several times faster than axes innermost.
            across, along = x - torch.clamp(x, low[0], high[0]), y - torch.clamp(y, low[1], high[1])
            return across.square() + along.square()

        distance = self._edges.of_each(squared, points, torch.amin, torch.minimum).sqrt()
        return torch.where(self.contains(points), -distance, distance)


class _Rectangles:
    """Some, sides parallel to the axes; those without width are edges."""

    def __init__(self, corners: Sequence[Sequence[Sequence[float]]]) -> None:
        """`corners`: (x, y) of the low and of the high one, in metres, of each."""
        self._corners = corners
        self._low, self._high = _tensor(corners).reshape(-1, 2, 2).permute(1, 2, 0)  # [2, n] each

    def of_each(
        self,
        measure: Callable[[Tensor, Tensor, Any, Any], Tensor],
        points: Tensor,
        best: Callable[..., Tensor],
        better: Callable[[Tensor, Tensor], Tensor],
    ) -> Tensor:
        """The `best` of what `measure` says of x and y of points [..., 2] and of each one's corners: [...].

        `better` is the same, of two.
        """
        x, y = points.unbind(-1)
        if torch.compiler.is_compiling():  # a rectangle at a time: native code then takes many points at once
            return reduce(better, [measure(x, y, low, high) for low, high in self._corners])
        return best(measure(x.unsqueeze(-1), y.unsqueeze(-1), self._low.to(points), self._high.to(points)), dim=-1)


def _tensor(numbers: Sequence[Any]) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def _rows(tiles: Iterable[Tile]) -> list[tuple[int, int, int]]:
    """Neighbours along y joined: (i, first j, last j), fewer rectangles to compare points with."""
    rows: list[tuple[int, int, int]] = []
    for i, j in sorted(tiles):
        if rows and rows[-1][0] == i and rows[-1][2] == j - 1:
            rows[-1] = (i, rows[-1][1], j)
        else:
            rows.append((i, j, j))
    return rows


def _outline(tiles: set[Tile]) -> list[list[tuple[float, float]]]:
    """Border segments of a union of tiles, collinear neighbours joined, each as [low corner, high corner]."""
    half = TILE_SIDE / 2
    runs: dict[tuple[int, float], list[tuple[float, float]]] = {}
    for tile in sorted(tiles):
        center = tile_center(tile)
        for axis in (0, 1):
            for side in (-1, 1):
                neighbour = (tile[0] + side, tile[1]) if axis == 0 else (tile[0], tile[1] + side)
                if neighbour not in tiles:
                    across, along = center[axis] + side * half, center[1 - axis]
                    runs.setdefault((axis, round(across, 6)), []).append((along - half, along + half))
    segments = []
    for (axis, across), pieces in sorted(runs.items()):
        joined: list[tuple[float, float]] = []
        for low, high in sorted(pieces):
            if joined and abs(joined[-1][1] - low) < 1e-6:
                joined[-1] = (joined[-1][0], high)
            else:
                joined.append((low, high))
        for low, high in joined:
            corners = [(across, low), (across, high)] if axis == 0 else [(low, across), (high, across)]
            segments.append(corners)
    return segments


def table_distance(points: Tensor) -> Tensor:
    """Metres by which points [..., 2] lie inside the table's nearest edge, negative off the table: [...]."""
    sides = []
    for axis, (low, high) in enumerate(zip(TABLE_LOW, TABLE_HIGH, strict=True)):  # see `TileSet.signed_distance`
        sides.append(torch.minimum(points[..., axis] - low, high - points[..., axis]))
    return torch.minimum(*sides)
