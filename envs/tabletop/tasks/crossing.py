"""Crossing: the target has to reach a goal over a bridge (paper, section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from cavin_pyro.envs.tabletop.tasks.generated import GeneratedLayouts, paths, reachable_tiles, starting_tiles
from cavin_pyro.envs.tabletop.tasks.task import GOAL_MARKING, Marking, Step, Task, check_apart, check_inside
from cavin_pyro.envs.tabletop.tasks.tiles import TileSet
from cavin_pyro.envs.tabletop.workspace import TILE_SIDE

PUBLISHED_TOLERANCE = 1.5 * TILE_SIDE  # metres around the bridge, in real episodes of the published implementation


@dataclass(frozen=True, kw_only=True)
class Crossing(Task):
    """Push the target to the goal without leaving the bridge; obstacles may be anywhere.

    `region`: the bridge. `goal`: the tiles of the bridge where the target must arrive.
    """

    markings = (Marking("region", "bridge", "#5A5A5A", 0.35), GOAL_MARKING)
    movable = "goal"

    region: TileSet
    goal: TileSet

    def check(self) -> None:
        """The target starts on the bridge, off the goal."""
        check_apart(self.goal, self.target_start, "tile {tile} is both goal and target_start")
        for name in ("target_start", "goal"):
            check_inside(getattr(self, name), self.region, name + " tile {tile} is off the bridge, add it to region")

    def success(self, step: Step) -> Tensor:
        """The target is on a goal tile: [...] bool."""
        return self.goal.contains(step.target)

    def violation(self, step: Step) -> Tensor:
        """The target is off the bridge: [...] bool."""
        return step.target_enters(self.region.signed_distance)

    def published_violation(self, step: Step) -> Tensor:
        """The target is more than `PUBLISHED_TOLERANCE` off the bridge: [...] bool."""
        return step.target_enters(lambda points: self.region.signed_distance(points) - PUBLISHED_TOLERANCE)

    def potential(self, positions: Tensor, mask: Tensor) -> Tensor:
        """Minus the target's distance to the nearest centre of a goal tile."""
        return -self.goal.distance_to_nearest_center(positions[..., 0, :])

    @classmethod
    def generate(cls, wanted: GeneratedLayouts, generator: np.random.Generator) -> Task:
        """A bridge without shortcuts, from its first tile to its last; obstacles start on reachable tiles."""
        starts = starting_tiles()
        bridges = {shape: [path for path in found if path[0] in starts] for shape, found in paths(wanted.tiles).items()}
        bridge = wanted.sample("bridge", bridges, generator)
        return cls(
            region=TileSet(sorted(bridge)),
            goal=TileSet(bridge[-1:]),
            target_start=TileSet(bridge[:1]),
            obstacle_start=TileSet(reachable_tiles()),
        )
