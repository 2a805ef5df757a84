"""Gathering: all objects have to be in a region. Not in the paper."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cavin_pyro.envs.tabletop.tasks.task import Marking, Step, Task, check_apart
from cavin_pyro.envs.tabletop.tasks.tiles import TileSet


@dataclass(frozen=True, kw_only=True)
class Gathering(Task):
    """Push every object into the region. Only falls off the table are forbidden.

    A margin makes the region smaller for planners, and keeps objects within reach until they have arrived.

    `region`: the tiles that all objects have to reach; no object starts within.
    """

    markings = (Marking("region", "gather here", "#F2C200", 0.50),)
    movable = "region"
    about = "all"

    region: TileSet

    def check(self) -> None:
        """No object starts in the region."""
        for name in ("target_start", "obstacle_start"):
            check_apart(getattr(self, name), self.region, name + " tile {tile} is in the region to gather in")

    def success(self, step: Step) -> Tensor:
        """Every object's centre is in the region: [...] bool."""
        return step.all_within(self.region.depth)

    def dead_end(self, step: Step) -> Tensor:
        """An object is pushed out of the tool's reach outside of the region: [...] bool."""
        return step.any_leaves_reach(self.region.contains)

    def potential(self, positions: Tensor, mask: Tensor) -> Tensor:
        """Minus the sum, over objects outside of the region, of the distance to it."""
        distances = self.region.signed_distance(positions).clamp(min=0.0)
        return -torch.where(mask, distances, 0.0).sum(dim=-1)
