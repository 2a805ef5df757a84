"""Unions of tiles and distances to them, as pure functions of tensors with any leading dimensions."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from envs.workspace import TABLE_HIGH, TABLE_LOW, TILE_COUNT, TILE_SIDE, Tile, tile_center


class TileSet:
    """A union of tiles with an exact signed distance. Equal if the tiles and their order are.

    Args:
        tiles: may be empty, but then no distance is defined.
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
        moved.centers = self.centers.to(device)
        moved._rows, moved._edges = self._rows.to(device), self._edges.to(device)
        return moved

    def contains(self, points: Tensor) -> Tensor:
        """Whether points [..., 2] metres lie in the union, its border included: [...] bool."""

        def depth(x: Tensor, y: Tensor, low: Tensor, high: Tensor) -> Tensor:
            across, along = torch.minimum(x - low[0], high[0] - x), torch.minimum(y - low[1], high[1] - y)
            return torch.minimum(across, along)

        return self._rows.of_each(depth, points, torch.amax) >= 0.0

    def signed_distance(self, points: Tensor) -> Tensor:
        """Metres from points [..., 2] to the union's outline, negative inside: [...]."""

        def squared(x: Tensor, y: Tensor, low: Tensor, high: Tensor) -> Tensor:
            across, along = x - torch.clamp(x, low[0], high[0]), y - torch.clamp(y, low[1], high[1])
            return across.square() + along.square()

        distance = self._edges.of_each(squared, points, torch.amin).sqrt()
        return torch.where(self.contains(points), -distance, distance)

    def depth(self, points: Tensor) -> Tensor:
        """Metres by which points [..., 2] are inside of the union, negative outside: [...]."""
        return -self.signed_distance(points)

    def distance_to_nearest_center(self, points: Tensor) -> Tensor:
        """Metres from points [..., 2] to the nearest centre of a tile: [...]."""
        return (points.unsqueeze(-2) - self.centers.to(points)).norm(dim=-1).amin(dim=-1)


class _Rectangles:
    """Some, sides parallel to the axes; those without width are edges."""

    def __init__(self, corners: Sequence[Sequence[Sequence[float]]]) -> None:
        """`corners`: (x, y) of the low and of the high one, in metres, of each."""
        self._low, self._high = _tensor(corners).reshape(len(corners), 2, 2).permute(1, 2, 0)  # [2, n] each

    def to(self, device: torch.device) -> _Rectangles:
        moved = copy.copy(self)
        moved._low, moved._high = self._low.to(device), self._high.to(device)
        return moved

    def of_each(
        self,
        measure: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
        points: Tensor,
        best: Callable[..., Tensor],
    ) -> Tensor:
        """The `best` of what `measure` says of x and y of points [..., 2] and of all low and high corners: [...]."""
        x, y = points.unbind(-1)
        # Rectangles are the first dimension: a minimum over the last one takes twice as long.
        low, high = (corner.to(points).unflatten(1, (-1, *[1] * x.ndim)) for corner in (self._low, self._high))
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
    return box_distance(points, TABLE_LOW, TABLE_HIGH)


def box_distance(points: Tensor, lows: Sequence[float], highs: Sequence[float]) -> Tensor:
    """Metres by which points [..., 2] lie inside the nearest side of a box, negative outside: [...]."""
    sides = []
    for axis, (low, high) in enumerate(zip(lows, highs, strict=True)):  # both at once would be slower
        sides.append(torch.minimum(points[..., axis] - low, high - points[..., axis]))
    return torch.minimum(*sides)


def parse_tiles(value: Any, name: str) -> tuple[Tile, ...]:
    """Check a list of tiles from Python or YAML.

    Raises:
        ValueError: it is no list, or a tile is malformed, listed twice or off the table; `name` says which list it is.
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
