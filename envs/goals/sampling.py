"""Random places for objects."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from envs.markings import Place
from envs.objects.sampling import arrange
from envs.workspace import TILE_SIDE, Tile, tile_center


def sample_places(
    region: Iterable[Tile], count: int, clearance: float, generator: np.random.Generator
) -> tuple[Place, ...]:
    """Places (x, y) in metres, uniform on some tiles, no two closer than `clearance` metres.

    Raises:
        ValueError: the region is too small for so many.
    """
    half = TILE_SIDE / 2
    centers = [tile_center(tile) for tile in region]
    area = [((x - half, y - half), (x + half, y + half)) for x, y in centers]
    try:
        places = arrange([area] * count, clearance, generator)
    except ValueError as error:
        raise ValueError(
            f"no room for {count} places at least {clearance:g} m apart in the region: add tiles to it, or lower "
            "task.clearance"
        ) from error
    return tuple((float(x), float(y)) for x, y in places)
