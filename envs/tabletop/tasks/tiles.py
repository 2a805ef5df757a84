"""Unions of tiles and distances to them or along them, as pure functions of tensors with any leading dimensions."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.envs.tabletop.workspace import TABLE_HIGH, TABLE_LOW, TILE_COUNT, TILE_SIDE, Tile, tile_center


class TileSet:
    """A union of tiles with an exact signed distance. Equal if the tiles and their order are.

    `tiles`: may be empty, but then no distance is defined.
    """

    def __init__(self, tiles: Iterable[Tile]) -> None:
        self.tiles = tuple(tiles)
        self.centers = _tensor([tile_center(tile) for tile in self.tiles]).reshape(-1, 2)
        # Neighbours compute their common border from the same half index, so that rounding leaves no gap.
        rows = [
            (tile_center((i - 0.5, first - 0.5)), tile_center((i + 0.5, last + 0.5)))
            for i, first, last in _rows(self.tiles)
        ]
        # Corners of rectangles; those without width are edges.
        self._rows, self._edges = _rectangles(rows), _rectangles(_outline(set(self.tiles)))

    def __iter__(self) -> Iterator[Tile]:
        return iter(self.tiles)

    def __len__(self) -> int:
        return len(self.tiles)

    def __eq__(self, other: object) -> bool:
        return self.tiles == other.tiles if isinstance(other, TileSet) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.tiles)

    def __repr__(self) -> str:
        return f"TileSet({list(self.tiles)})"

    def to(self, device: torch.device) -> TileSet:
        """The same tiles with their numbers on a device; points elsewhere cost a copy in every call."""
        if self.centers.device == device:
            return self
        moved = copy.copy(self)
        moved.centers, moved._rows, moved._edges = (part.to(device) for part in (self.centers, self._rows, self._edges))
        return moved

    def contains(self, points: Tensor) -> Tensor:
        """Whether points [..., 2] metres lie in the union, its border included: [...] bool."""

        def depth(x: Tensor, y: Tensor, low: Tensor, high: Tensor) -> Tensor:
            across, along = torch.minimum(x - low[0], high[0] - x), torch.minimum(y - low[1], high[1] - y)
            return torch.minimum(across, along)

        return _of_each(self._rows, depth, points, torch.amax) >= 0.0

    def signed_distance(self, points: Tensor) -> Tensor:
        """Metres from points [..., 2] to the union's outline, negative inside: [...]."""

        def squared(x: Tensor, y: Tensor, low: Tensor, high: Tensor) -> Tensor:
            across, along = x - torch.clamp(x, low[0], high[0]), y - torch.clamp(y, low[1], high[1])
            return across.square() + along.square()

        distance = _of_each(self._edges, squared, points, torch.amin).sqrt()
        return torch.where(self.contains(points), -distance, distance)

    def depth(self, points: Tensor) -> Tensor:
        """Metres by which points [..., 2] are inside of the union, negative outside: [...]."""
        return -self.signed_distance(points)

    def distance_to_nearest_center(self, points: Tensor) -> Tensor:
        """Metres from points [..., 2] to the nearest centre of a tile: [...]."""
        return (points.unsqueeze(-2) - self.centers.to(points)).norm(dim=-1).amin(dim=-1)


Corners = Sequence[Sequence[Sequence[float]]]
"""Of rectangles, sides parallel to the axes: (x, y) of the low and of the high one, in metres, of each."""


def _rectangles(corners: Corners) -> Tensor:
    """The low and the high corners: [2, 2, n]."""
    return _tensor(corners).reshape(len(corners), 2, 2).permute(1, 2, 0)


def _of_each(
    corners: Tensor,
    measure: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
    points: Tensor,
    best: Callable[..., Tensor],
) -> Tensor:
    """The `best` of what `measure` says of x and y of points [..., 2] and of all low and high corners: [...]."""
    x, y = points.unbind(-1)
    # Rectangles are the first dimension: a minimum over the last one takes twice as long.
    low, high = corners.to(points).unflatten(2, (-1, *[1] * x.ndim))
    return best(measure(x, y, low, high), dim=0)


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
    segments = []
    for exchanged in (False, True):  # borders between rows i and i + 1, then between columns
        own = {(j, i) for i, j in tiles} if exchanged else tiles
        for i, first, last in _rows(own ^ {(i - 1, j) for i, j in own}):
            corners = (i + 0.5, first - 0.5), (i + 0.5, last + 0.5)
            segments.append([tile_center((y, x) if exchanged else (x, y)) for x, y in corners])
    return segments


def table_distance(points: Tensor) -> Tensor:
    """Metres by which points [..., 2] lie inside the table's nearest edge, negative off the table: [...]."""
    return box_distance(points, TABLE_LOW, TABLE_HIGH)


def box_distance(points: Tensor, lows: Sequence[float], highs: Sequence[float]) -> Tensor:
    """Metres by which points [..., 2] lie inside the nearest side of a box, negative outside: [...]."""
    sides = []
    for axis, (low, high) in enumerate(zip(lows, highs, strict=True)):  # both at once would be slower
        sides.append(torch.minimum(points[..., axis] - low, high - points[..., axis]))
    return torch.minimum(*sides)


def parse_tiles(value: Any, name: str) -> tuple[Tile, ...]:
    """Check a list of tiles from Python or YAML.

    Raises ValueError: it is no list, or a tile is malformed, listed twice or off the table; `name` says which list it
    is.
    """
    if isinstance(value, TileSet):
        value = value.tiles
    if not isinstance(value, list | tuple):
        raise ValueError(f"{name} must be a list of tiles such as [[2, 3], [2, 4]], not {value!r}")
    tiles: list[Tile] = []
    for entry in value:
        is_pair = isinstance(entry, list | tuple) and len(entry) == 2
        if not (is_pair and all(type(index) is int for index in entry)):
            raise ValueError(f"{name}: a tile is two whole numbers such as [2, 3], not {entry!r}")
        tile = (entry[0], entry[1])
        if not all(0 <= index < count for index, count in zip(tile, TILE_COUNT, strict=True)):
            last = [count - 1 for count in TILE_COUNT]
            raise ValueError(f"{name}: tile {list(tile)} is off the table, which holds [0, 0] to {last}")
        if tile in tiles:
            raise ValueError(f"{name}: tile {list(tile)} is listed twice, tiles must not overlap")
        tiles.append(tile)
    return tuple(tiles)


SPACING = TILE_SIDE / 15  # metres between the grid's points; no point lies on a tile's border
_COUNT = tuple(round((high - low) / SPACING) for low, high in zip(TABLE_LOW, TABLE_HIGH, strict=True))
_FIRST = tuple(low + SPACING / 2 for low in TABLE_LOW)


class DistanceField:
    """Length of the shortest path from each point of the table to the nearest goal point, along allowed points.

    It is computed once and interpolated anywhere. A goal may lie beyond a planner's horizon; the straight distance is
    then misleading: on a U-shaped bridge the end is near the start.

    From a point that is not allowed, or without such a path, it is the length of the shortest path that also crosses
    forbidden places. Between the points of the grid it is bilinear. Without a goal point it is 0 everywhere.

    `allowed`, `goal`: which points of the `grid()` are, [rows, columns] bool. `device`: of its numbers; points
    elsewhere cost a copy in every call.

    Attributes:
        longest: metres, an upper bound on all lengths.
    """

    def __init__(self, allowed: Tensor, goal: Tensor, device: torch.device) -> None:
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
        self._cells = torch.from_numpy(np.stack(corners, -1).reshape(-1, 4).astype(np.float32)).to(device)
        self._first = torch.tensor(_FIRST, device=device)
        self._last = torch.tensor([count - 1.001 for count in _COUNT], device=device)  # within the last cell

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
