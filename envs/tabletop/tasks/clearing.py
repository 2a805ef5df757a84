"""Clearing: no object may remain in a region (paper, section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cavin_pyro.envs.tabletop.tasks.generated import GeneratedLayouts, blocks, paths
from cavin_pyro.envs.tabletop.tasks.task import Marking, Step, Task, check_inside
from cavin_pyro.envs.tabletop.tasks.tiles import TileSet, table_distance


@dataclass(frozen=True, kw_only=True)
class Clearing(Task):
    """Push every object out of the region.

    A margin makes the region larger for planners, and keeps objects within reach until they have left it.

    `region`: the tiles to clear; the target starts within.
    """

    markings = (Marking("region", "to clear", "#0072B2", 0.35),)
    movable = "region"
    about = "all"

    region: TileSet

    def check(self) -> None:
        """The target starts in the region, or an episode could end before it begins."""
        check_inside(self.target_start, self.region, "target_start tile {tile} is outside the region to clear")

    def success(self, step: Step) -> Tensor:
        """No object is in the region: [...] bool."""
        return step.all_within(self.region.signed_distance)

    def dead_end(self, step: Step) -> Tensor:
        """An object is pushed out of the tool's reach within the region, as at the robot's side: [...] bool."""
        return step.any_leaves_reach(lambda points: ~self.region.contains(points))

    def potential(self, positions: Tensor, mask: Tensor) -> Tensor:
        """Virtual goals lie at the table's edges: minus the sum, over objects in the region, of the distance to one."""
        remaining = self.region.contains(positions) & mask
        return -torch.where(remaining, table_distance(positions), 0.0).sum(dim=-1)

    @classmethod
    def generate(cls, wanted: GeneratedLayouts, generator: np.random.Generator) -> Task:
        """A strip of any shape or a rectangle, in which all objects start."""
        by_shape = {**paths(wanted.tiles), "block": blocks(wanted.tiles)}
        tiles = TileSet(sorted(wanted.sample("region", by_shape, generator)))
        return cls(region=tiles, target_start=tiles, obstacle_start=tiles)
