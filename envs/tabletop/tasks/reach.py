"""Whether pushes can solve a layout at all: the tool has to get behind an object to push it on."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count, product

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.tasks.reward import TaskReward, outcome_alone
from cavin_pyro.envs.tabletop.tasks.task import Task
from cavin_pyro.envs.tabletop.tasks.tiles import grid, table_distance
from cavin_pyro.envs.tabletop.workspace import REACH_HIGH, REACH_LOW, TILE_ORIGIN, TILE_SIDE, tile_center

BEHIND = 0.02  # metres from the centre of the thinnest object to the tool that pushes it
BESIDE = 0.05  # metres by which a push may miss the centre and still move an object

Mask = NDArray[np.bool_]
Moves = Sequence[tuple[int, int, Mask]]
"""Steps on a grid [I, J]: the axis, forwards (1) or backwards (-1), and from which points."""


def check_reach(task: Task) -> None:
    """Check that pushes along x and y can bring an object, alone on the table, from every start tile to the goal.

    A task passes that has a goal for each object, or one that no object reaches alone. Raises ValueError: from a start
    tile they cannot; it is named, and so is the tile where pushes end.
    """
    if not task.goal_is_shared:
        return
    points = grid()[1::3, ::3]  # with the centres of tiles, 3 cm apart
    outcome, places = outcome_alone(TaskReward(task), points), points.numpy()
    inner = table_distance(points) > 0.03  # every point has four neighbours
    free, goal = (~outcome.failure & inner).numpy(), (outcome.success & inner).numpy()
    if not goal.any():
        return
    pushes = [(axis, sign, _can_push(places, axis, sign)) for axis, sign in product((0, 1), (1, -1))]
    solved = _steps(goal, free, [(axis, -sign, np.roll(possible, sign, axis)) for axis, sign, possible in pushes])
    away = _steps(goal, free, [(axis, sign, np.ones_like(free)) for axis, sign, _ in pushes])
    for name in ("target_start", "obstacle_start") if task.about == "all" else ("target_start",):
        for tile in getattr(task, name):
            start = np.linalg.norm(places - tile_center(tile), axis=-1)
            start = start == start.min()
            if (away[start] < 0).all():
                raise ValueError(f"{name} tile {list(tile)}: no way leads to the goal: open one for it")
            if (solved[start] < 0).all():
                reached = _steps(start, free, pushes) >= 0
                last = places[np.unravel_index(np.where(reached, away, away.max() + 1).argmin(), away.shape)]
                stuck = np.rint((last - TILE_ORIGIN) / TILE_SIDE).astype(int).tolist()
                raise ValueError(
                    f"{name} tile {list(tile)}: no push leads on from tile {stuck} to the goal, since the tool reaches "
                    f"x {REACH_LOW[0]} to {REACH_HIGH[0]} m and must be behind an object: use tiles [1, 0] to [3, 6]"
                )


def _can_push(places: NDArray[np.float64], axis: int, sign: int) -> Mask:
    """From which places [I, J, 2] metres the tool can push an object along an axis to the next one: [I, J]."""
    behind, aside = places[..., axis] - sign * BEHIND, places[..., 1 - axis]
    low, high = REACH_LOW[1 - axis] - BESIDE, REACH_HIGH[1 - axis] + BESIDE
    there = behind >= REACH_LOW[axis] if sign > 0 else behind <= REACH_HIGH[axis]
    return there & (low <= aside) & (aside <= high)


def _steps(begin: Mask, free: Mask, moves: Moves) -> NDArray[np.int64]:
    """How many moves over free points lead from a point of `begin` to each point [I, J]; -1 if none do."""
    steps = np.where(begin, 0, -1)
    for number in count(1):
        known = steps >= 0
        new = np.any([np.roll(known & possible, sign, axis) for axis, sign, possible in moves], axis=0)
        new &= free & ~known
        if not new.any():
            break
        steps[new] = number
    return steps
