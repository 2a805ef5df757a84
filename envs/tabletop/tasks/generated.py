"""Generated layouts: what is wanted of one, and the tiles that the tool can use.

A task generates its own layouts (`Task.generate`); the paths here are bridges to cross and regions to clear.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from types import MappingProxyType
from typing import TypeVar

import numpy as np

from cavin_pyro.envs.tabletop.workspace import REACH_HIGH, REACH_LOW, TILE_COUNT, Tile, tile_center
from cavin_pyro.models.checks import check_choice, check_number

ROOM = 0.05  # metres that the tool's reach extends beyond the centre of a tile that layouts use
# Metres beyond the centre of a tile on which the target starts, so that the tool gets behind it on every side: it may
# lie 0.05 off the centre (`TARGET_JITTER`) and extend 0.05 from there, and the tool needs 0.02 more.
ROOM_AT_START = 0.12
SHAPES = ("straight", "l", "u", "s", "winding", "block")
ANY_SHAPE = "any"
FEWEST, MOST = 4, 14  # tiles

Path = tuple[Tile, ...]
"""Tiles from start to end, each a neighbour of the next and of no other."""

Choice = TypeVar("Choice")


@dataclass(frozen=True)
class GeneratedLayouts:
    """What is wanted of generated layouts.

    tiles: how difficult they are, 4 to 14. Of a bridge to cross, start and goal included; of a region to clear; of the
        way to a slot, its own included (at most 8).
    shape: of a bridge or a region: straight, l, u, s (two turns to different sides), winding (more turns), or any, all
        equally likely; of a region also block, a rectangle.

    Raises ValueError: a number out of its range, or an unknown name.
    """

    tiles: int = 6
    shape: str = ANY_SHAPE

    def __post_init__(self) -> None:
        check_number("generated.tiles", self.tiles, FEWEST, MOST, whole=True)
        check_choice("generated.shape", self.shape, (*SHAPES, ANY_SHAPE))

    def sample(self, what: str, by_shape: Mapping[str, Sequence[Choice]], generator: np.random.Generator) -> Choice:
        """One of the choices of the wanted shape; of any shape, all shapes that there are are equally likely.

        Raises ValueError: there is none of that shape; `what` says of what.
        """
        there = [shape for shape in SHAPES if by_shape.get(shape)]
        if self.shape != ANY_SHAPE and self.shape not in there:
            raise ValueError(
                f"no {what} of {self.tiles} tiles is generated with shape={self.shape}: "
                f"choose generated.shape={', '.join([*there, ANY_SHAPE])}, or another generated.tiles"
            )
        shape = there[int(generator.integers(len(there)))] if self.shape == ANY_SHAPE else self.shape
        return by_shape[shape][int(generator.integers(len(by_shape[shape])))]


def reachable_tiles(room: float = ROOM) -> tuple[Tile, ...]:
    """The tiles that layouts use: the tool reaches `room` metres beyond their centres on every side."""
    rows, columns = (
        [
            number
            for number in range(TILE_COUNT[axis])
            if REACH_LOW[axis] + room <= tile_center((number, number))[axis] <= REACH_HIGH[axis] - room
        ]
        for axis in (0, 1)
    )
    return tuple((i, j) for i in rows for j in columns)


def starting_tiles() -> tuple[Tile, ...]:
    """The tiles on which the target may start: the tool gets behind it on every side.

    At the border of the tool's reach, pushes move objects outwards only, and no planner brings them back.
    """
    return reachable_tiles(ROOM_AT_START)


def neighbours(tile: Tile) -> tuple[Tile, ...]:
    """The four tiles beside a tile, on the table or not."""
    i, j = tile
    return (i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)


@lru_cache
def paths(tiles: int) -> Mapping[str, tuple[Path, ...]]:
    """All paths of that many reachable tiles that have no shortcut, in both directions, by shape."""
    found: dict[str, list[Path]] = {}
    for start in reachable_tiles():
        for path in _longer((start,), tiles, frozenset(reachable_tiles())):
            found.setdefault(_shape(path), []).append(path)
    return MappingProxyType({shape: tuple(found[shape]) for shape in SHAPES if shape in found})


def _longer(path: Path, tiles: int, allowed: frozenset[Tile]) -> Iterator[Path]:
    if len(path) == tiles:
        yield path
        return
    for tile in neighbours(path[-1]):
        if tile in allowed and set(neighbours(tile)) & set(path) == {path[-1]} and tile not in path:
            yield from _longer((*path, tile), tiles, allowed)


def _shape(path: Path) -> str:
    steps = [(after[0] - before[0], after[1] - before[1]) for before, after in pairwise(path)]
    turns = [a[0] * b[1] - a[1] * b[0] for a, b in pairwise(steps) if a != b]  # 1 left, -1 right
    if len(turns) == 2:
        return "u" if turns[0] == turns[1] else "s"
    return ("straight", "l")[len(turns)] if len(turns) < 2 else "winding"


def blocks(tiles: int) -> tuple[Path, ...]:
    """All rectangles of that many reachable tiles, at least two tiles wide either way."""
    reachable = set(reachable_tiles())
    found = []
    for height in range(2, tiles // 2 + 1):
        width, rest = divmod(tiles, height)
        for i, j in sorted(reachable):
            block = tuple((row, column) for row in range(i, i + height) for column in range(j, j + width))
            if not rest and set(block) <= reachable:
                found.append(block)
    return tuple(found)
