"""The tiles of a layout and objects' places in colour pictures for people; never in the depth image or in the mask.

Markings colour the pixels of a rendered picture that show the table's top. They are no body of the simulator: nothing
can touch them, they are not in the depth image, and objects occlude them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.sensors.camera import Camera
from cavin_pyro.envs.tabletop.sensors.sensor import Rendering
from cavin_pyro.envs.tabletop.workspace import TILE_COUNT, TILE_ORIGIN, TILE_SIDE, Tile

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


Paint = Callable[[Rendering, Sequence[int]], NDArray[np.uint8]]
"""A copy of a rendered picture [height, width, 3] with the markings that no body of the given objects hides."""


@lru_cache(maxsize=8)  # a film has a hundred pictures by one camera
def paint_of(
    camera: Camera,
    groups: tuple[TileGroup, ...],
    places: tuple[Place, ...] = (),
    colors: tuple[tuple[float, float, float], ...] = (),
) -> Paint:
    """Paint groups of tiles, and over them a disc at each object's place.

    `places`: centres of the discs. `colors`: of each disc, red, green and blue from 0 to 1.
    """
    rows, columns = (numbers.ravel() for numbers in np.indices((camera.height, camera.width)))
    ahead = camera.points(np.ones((camera.height, camera.width)), rows, columns) - np.array(camera.position)
    down = np.flatnonzero(ahead[:, 2] < 0.0)
    rows, columns, ahead = rows[down], columns[down], ahead[down]
    camera_height, falls = camera.position[2], -ahead[:, 2]
    points = np.array(camera.position[:2]) + ahead[:, :2] * (camera_height / falls)[:, None]
    kept: NDArray[np.float64] = np.ones((len(points), 1))
    added: NDArray[np.float64] = np.zeros((len(points), 3))
    discs = (_of_place(points, place, color) for place, color in zip(places, colors, strict=False))
    for opacity, color in (*(_of_tiles(points, group) for group in groups), *discs):
        kept = kept * (1.0 - opacity)
        added = added * (1.0 - opacity) + opacity * color
    marked = np.flatnonzero(kept < 1.0)
    rows, columns, falls, kept, added = (part[marked] for part in (rows, columns, falls, kept, added))

    def paint(rendering: Rendering, objects: Sequence[int]) -> NDArray[np.uint8]:
        height = camera_height - rendering.depth[rows, columns] * falls
        seen = np.flatnonzero((np.abs(height) < LEVEL) & ~np.isin(rendering.bodies[rows, columns], objects))
        where = rows[seen], columns[seen]
        painted = rendering.color.copy()
        painted[where] = np.rint(kept[seen] * painted[where] + added[seen]).astype(np.uint8)
        return painted

    return paint


Opacity = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Of points on the table [P, 1], 0 where nothing is painted, and the colour [3], 0 to 255."""


def _of_tiles(points: NDArray[np.float64], group: TileGroup) -> Opacity:
    """A fill, and an opaque line along the edge of every tile."""
    exact = (points - np.array(TILE_ORIGIN)) / TILE_SIDE
    tile = np.floor(exact + 0.5).astype(np.intp)
    on_grid = ((tile >= 0) & (tile < TILE_COUNT)).all(axis=-1)
    tile = np.where(on_grid[:, None], tile, 0)
    chosen = np.zeros(TILE_COUNT, dtype=np.bool_)
    chosen[tuple(np.array(group.tiles).T)] = True
    to_edge = TILE_SIDE * (0.5 - np.abs(exact - tile).max(axis=-1))  # metres
    border = np.clip(1.5 - to_edge / BORDER, 0.0, 1.0)  # fades over one width: smooth edges
    opacity = np.where(on_grid & chosen[tile[:, 0], tile[:, 1]], group.opacity + (1.0 - group.opacity) * border, 0.0)
    return opacity[:, None], np.array([int(group.color[start : start + 2], 16) for start in (1, 3, 5)], dtype=float)


def _of_place(points: NDArray[np.float64], place: Place, color: tuple[float, float, float]) -> Opacity:
    """A disc with an opaque line around it."""
    to_edge = PLACE_RADIUS - np.linalg.norm(points - np.array(place), axis=-1)  # metres
    border = np.clip(2.5 - to_edge / BORDER, 0.0, 1.0)
    opacity = np.where(to_edge >= 0.0, PLACE_OPACITY + (1.0 - PLACE_OPACITY) * border, 0.0)
    return opacity[:, None], 255.0 * np.array(color)
