"""The tiles of a layout and objects' places in colour pictures for people; never in the depth image or in the mask.

`paint_tiles` and `paint_places` colour the pixels of a rendered picture that show the table's top. What they paint is
no body of the simulator: nothing can touch it, it is not in the depth image, and objects occlude it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.workspace import TILE_COUNT, TILE_ORIGIN, TILE_SIDE, Tile

LEVEL = 0.002  # metres; points at most this far from z = 0 belong to the table's top
BORDER = 0.003  # metres on either side of a tile's edge with an opaque line
PLACE_RADIUS = 0.03  # metres; of the disc that marks an object's place
PLACE_OPACITY = 0.45


Place = tuple[float, float]
"""A point (x, y) on the table, metres."""


class TileGroup(NamedTuple):
    """Tiles of one meaning: name for legends, colour, opacity of the fill, and the tiles."""

    name: str
    color: str
    opacity: float
    tiles: tuple[Tile, ...]


def paint_tiles(
    picture: NDArray[np.uint8],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    places: NDArray[np.floating],
    groups: Sequence[TileGroup],
) -> NDArray[np.uint8]:
    """A copy of a picture with tiles on some of its pixels.

    Args:
        picture: [height, width, 3]. rows, columns: [P] pixels that show the table's top.
        places: [P, 2] where on the table they lie, metres.
    """
    exact = (places - np.array(TILE_ORIGIN)) / TILE_SIDE
    tile = np.floor(exact + 0.5).astype(np.intp)
    on_grid = ((tile >= 0) & (tile < TILE_COUNT)).all(axis=-1)
    tile = np.where(on_grid[:, None], tile, 0)
    to_edge = TILE_SIDE * (0.5 - np.abs(exact - tile).max(axis=-1))  # metres
    painted = picture.copy()
    for group in groups:
        chosen = np.zeros(TILE_COUNT, dtype=np.bool_)
        chosen[tuple(np.array(group.tiles).T)] = True
        inside = np.flatnonzero(on_grid & chosen[tile[:, 0], tile[:, 1]])
        border = np.clip(1.5 - to_edge[inside] / BORDER, 0.0, 1.0)  # fades over one width: smooth edges
        opacity = (group.opacity + (1.0 - group.opacity) * border)[:, None]
        where = rows[inside], columns[inside]
        color = np.array([int(group.color[start : start + 2], 16) for start in (1, 3, 5)])
        painted[where] = np.rint((1.0 - opacity) * painted[where] + opacity * color).astype(np.uint8)
    return painted


def paint_places(
    picture: NDArray[np.uint8],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    points: NDArray[np.floating],
    places: Sequence[Place],
    colors: Sequence[tuple[float, float, float]],
) -> NDArray[np.uint8]:
    """A copy of a picture with a disc at each object's place.

    Args:
        picture, rows, columns, points: as of `paint_tiles`.
        places: centres of the discs. colors: of each disc, red, green and blue from 0 to 1.
    """
    painted = picture.copy()
    for place, color in zip(places, colors, strict=False):
        to_edge = PLACE_RADIUS - np.linalg.norm(points - np.array(place), axis=-1)  # metres
        inside = np.flatnonzero(to_edge >= 0.0)
        border = np.clip(2.5 - to_edge[inside] / BORDER, 0.0, 1.0)
        opacity = (PLACE_OPACITY + (1.0 - PLACE_OPACITY) * border)[:, None]
        where = rows[inside], columns[inside]
        mixed = (1.0 - opacity) * painted[where] + opacity * 255.0 * np.array(color)
        painted[where] = np.rint(mixed).astype(np.uint8)
    return painted
