"""Insertion: the target has to go into a slot that restricted tiles surround (paper, section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from cavin_pyro.envs.tabletop.tasks.generated import (
    ANY_SHAPE,
    GeneratedLayouts,
    neighbours,
    reachable_tiles,
    starting_tiles,
)
from cavin_pyro.envs.tabletop.tasks.task import GOAL_MARKING, Marking, Step, Task, check_apart
from cavin_pyro.envs.tabletop.tasks.tiles import TileSet
from cavin_pyro.envs.tabletop.workspace import TILE_COUNT, Tile

_ROWS, _COLUMNS = TILE_COUNT  # along x, away from the robot; along y


@dataclass(frozen=True, kw_only=True)
class Insertion(Task):
    """Push the target into the slot; no object may enter the restricted region.

    `region`: the restricted tiles. `goal`: the slot.
    """

    markings = (Marking("region", "keep out", "#C2272D", 0.40), GOAL_MARKING)
    movable = "goal"

    region: TileSet
    goal: TileSet

    def check(self) -> None:
        """Nothing starts on restricted tiles, and the target starts outside of the slot."""
        check_apart(self.goal, self.target_start, "tile {tile} is both goal and target_start")
        for name in ("goal", "target_start", "obstacle_start"):
            check_apart(getattr(self, name), self.region, name + " tile {tile} overlaps the restricted region")

    def success(self, step: Step) -> Tensor:
        """The target is in the slot: [...] bool."""
        return self.goal.contains(step.target)

    def violation(self, step: Step) -> Tensor:
        """An object is in the restricted region: [...] bool."""
        return step.any_enters(self.region.depth)

    def published_violation(self, step: Step) -> Tensor:
        """Never: the published implementation ends no real episode of insertion for a violation."""
        return torch.zeros_like(step.mask[..., 0])

    def potential(self, positions: Tensor, mask: Tensor) -> Tensor:
        """Minus the target's distance to the nearest centre of a tile of the slot."""
        return -self.goal.distance_to_nearest_center(positions[..., 0, :])

    @classmethod
    def random_layouts(cls) -> tuple[Task, ...]:
        """Every place of the slot: three along either short side, one tile wide, and four along the far side, two wide.

        "A slot is placed randomly along one of the sides of the table, surrounded by restricted area" (paper, appendix
        "Task Details"). The wall is two tiles deep and as long as its side, the slot leads through its inner half, and
        objects start as in the fixed layouts of that side. The side at the robot is excluded: no push could start
        behind an object two tiles away from it, at the end of the workspace.
        """
        short = [_slot_in_short_side(place, mirrored) for mirrored in (False, True) for place in range(1, _ROWS - 1)]
        return (*short, *(_slot_in_far_side(place) for place in range(1, _COLUMNS - 2)))

    @classmethod
    def generate(cls, wanted: GeneratedLayouts, generator: np.random.Generator) -> Task:
        """A slot as in `random_layouts`, and a start as many tiles away from it as wanted; obstacles start anywhere."""
        found = []
        for slot in cls.random_layouts():
            assert isinstance(slot, Insertion)
            ways = _ways(slot)
            if starts := [tile for tile in starting_tiles() if ways.get(tile) == wanted.tiles]:
                found.append((slot, starts))
        if not found or wanted.shape != ANY_SHAPE:
            raise ValueError(
                "ways to a slot have 4 to 8 tiles and any shape: choose generated.tiles=4 to 8 generated.shape=any"
            )
        slot, starts = found[generator.integers(len(found))]
        start = starts[generator.integers(len(starts))]
        free = [tile for tile in reachable_tiles() if tile in _ways(slot) and tile not in slot.goal]
        return replace(slot, target_start=TileSet([start]), obstacle_start=TileSet(free))


def _ways(slot: Insertion) -> dict[Tile, int]:
    """Tiles of the shortest way from each free tile to the slot, both included."""
    ways = dict.fromkeys(slot.goal, 1)
    edge = list(slot.goal)
    for tile in edge:
        for other in neighbours(tile):
            on_table = 0 <= other[0] < _ROWS and 0 <= other[1] < _COLUMNS
            if on_table and other not in ways and other not in slot.region.tiles:
                ways[other] = ways[tile] + 1
                edge.append(other)
    return ways


def _slot_in_short_side(place: int, mirrored: bool) -> Insertion:
    """At the right end of the table as the robot sees it (small y), or mirrored at the left one; 2 is layout 0."""

    def column(number: int) -> int:
        return _COLUMNS - 1 - number if mirrored else number

    goal = {(place, column(1))}
    wall = {(row, column(number)) for row in range(_ROWS) for number in (0, 1)}
    target = {(2, column(number)) for number in (3, 4)}
    obstacles = {(row, column(number)) for row in (1, 2, 3) for number in (3, 4)}
    return _insertion(wall - goal, goal, target, obstacles)


def _slot_in_far_side(place: int) -> Insertion:
    """At the side opposite the robot, as layout 2, whose slot is that at 3."""
    goal = {(_ROWS - 2, place), (_ROWS - 2, place + 1)}
    wall = {(row, column) for row in (_ROWS - 2, _ROWS - 1) for column in range(_COLUMNS)}
    target = {(1, column) for column in range(2, 6)}
    obstacles = {(row, column) for row in (1, 2) for column in range(2, 6)}
    return _insertion(wall - goal, goal, target, obstacles)


def _insertion(region: set[Tile], goal: set[Tile], target_start: set[Tile], obstacle_start: set[Tile]) -> Insertion:
    groups = {"region": region, "goal": goal, "target_start": target_start, "obstacle_start": obstacle_start}
    return Insertion(**{name: TileSet(sorted(tiles)) for name, tiles in groups.items()})
