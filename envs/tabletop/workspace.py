"""The table, the tool's reach and the tile grid: the fixed geometry.

All coordinates are metres in the robot's base frame; the table's top lies at z = 0. Source: the published
implementation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.models.checks import check_last
from cavin_pyro.models.space import Space

TABLE_LOW = (0.22, -0.61)  # metres; the table is 0.76 m by 1.22 m around (0.60, 0.00)
TABLE_HIGH = (0.98, 0.61)  # metres
TABLE_CENTER = (0.60, 0.00)  # metres
TABLE_THICKNESS = 0.1  # metres

REACH_LOW = (0.30, -0.55)  # metres; the planar box that the tool's tip may touch
REACH_HIGH = (0.80, 0.55)  # metres
MAXIMUM_MOTION = 0.1  # metres per push, on each axis

TILE_SIDE = 0.15  # metres
TILE_ORIGIN = (0.295, -0.485)  # metres; the centre of tile (0, 0)
TILE_COUNT = (5, 7)  # whole tiles on the table along x and y

SPACE = Space(  # the loss weights of the published implementation, divided by that of the KL terms, are its scales
    origin=(*TABLE_CENTER, 0.0),
    length=MAXIMUM_MOTION,  # so that inputs of networks are of order one
    step_range=0.15,
    subgoal_range=0.5,
    action_names=("start", "motion"),
    action_sizes=(2, 2),
    action_limits=(5.0, 1.0),  # of starts far outside of the reachable box [-1, 1]
    center_scale=0.01,
    feature_scale=0.1,  # of a vector of unit length
    action_scales=(0.077, 0.245),
    mirror=(1.0, -1.0, 1.0),
)
"""What networks must know of the table; lengths in metres."""

Tile = tuple[int, int]
"""A tile's numbers (i, j) along x and y."""

MAXIMUM_OBJECTS = 10  # on the table
OBJECT_SLOTS = 5  # of observations and datasets, M, unless they are for more objects
POINTS_PER_OBJECT = 256


def object_slots(objects: int) -> int:
    """M, to how many objects observations are padded in scenes of up to `objects`."""
    return max(OBJECT_SLOTS, objects)


def tile_center(tile: tuple[float, float]) -> tuple[float, float]:
    """Planar centre (x, y) in metres of tile (i, j); half a tile further lies the border to its neighbour."""
    return TILE_ORIGIN[0] + TILE_SIDE * tile[0], TILE_ORIGIN[1] + TILE_SIDE * tile[1]


def push_endpoints(action: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where the tool starts and stops for a normalised push.

    The start is scaled onto the reachable box, the motion by `MAXIMUM_MOTION`, the end is clipped to the box.

    `action`: [..., 4] (x, y, dx, dy), clipped to [-1, 1]. Returns start: [..., 2] metres; end: [..., 2] metres.
    """
    action = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
    check_last("action", action, 4)
    low, high = np.array(REACH_LOW), np.array(REACH_HIGH)
    start = low + (action[..., :2] + 1.0) / 2.0 * (high - low)
    end = np.clip(start + MAXIMUM_MOTION * action[..., 2:], low, high)
    return start, end


def normalised_push(start: NDArray[np.floating], motion: NDArray[np.floating]) -> NDArray[np.float64]:
    """The action [..., 4] that starts at `start` [..., 2] metres and moves by `motion` [..., 2] metres."""
    low, high = np.array(REACH_LOW), np.array(REACH_HIGH)
    for name, value in (("start", start), ("motion", motion)):
        check_last(name, np.asarray(value), 2)
    position = 2.0 * (np.asarray(start, dtype=np.float64) - low) / (high - low) - 1.0
    return np.concatenate([position, np.asarray(motion, dtype=np.float64) / MAXIMUM_MOTION], axis=-1)


def distance_to_path(
    points: NDArray[np.floating], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Planar metres from points [..., 2] to the straight lines from start [..., 2] to end [..., 2]."""
    line = end - start
    length = np.maximum((line**2).sum(axis=-1), 1e-12)
    along = np.clip(((points - start) * line).sum(axis=-1) / length, 0.0, 1.0)
    return np.linalg.norm(points - (start + along[..., None] * line), axis=-1)
