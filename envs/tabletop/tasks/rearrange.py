"""Rearranging: each object has to reach a place of its own, given or at random. Not in the paper."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.envs.tabletop.markings import Place
from cavin_pyro.envs.tabletop.objects.sampling import arrange
from cavin_pyro.envs.tabletop.observation import Observation
from cavin_pyro.envs.tabletop.tasks.task import Marking, Step, Task
from cavin_pyro.envs.tabletop.tasks.tiles import TileSet
from cavin_pyro.envs.tabletop.workspace import MAXIMUM_OBJECTS, TABLE_HIGH, TABLE_LOW, TILE_SIDE, Tile, tile_center
from cavin_pyro.models.checks import check_number

TOLERANCE = 0.03  # metres between an object's centre and its place, on the table, at most
LEAST_TOLERANCE = 0.01  # metres; a planner's margin leaves at least this


@dataclass(frozen=True, kw_only=True)
class Rearrange(Task):
    """Push every object to its place, in any order. Only falls off the table are forbidden.

    Places are for centres as observed: the mean of an object's visible points. Orientations do not count.

    A margin makes the tolerance smaller for planners, and keeps objects within reach until they have arrived.

    Attributes:
        region: the tiles on which random places lie.
        clearance: metres between random places, at least.
        places: (x, y) metres of each object, in order; by default every episode samples its own.
    """

    markings = (Marking("region", "region of places", "#F2C200", 0.12),)
    about = "all"
    goal_is_shared = False

    region: TileSet
    clearance: float = 0.15
    places: Sequence[Place] = ()

    def check(self) -> None:
        """The places are on the table."""
        places = _places(self.places)
        padded = torch.zeros(MAXIMUM_OBJECTS, 2, dtype=torch.float64)
        padded[: len(places)] = torch.tensor(places, dtype=torch.float64).reshape(-1, 2)
        object.__setattr__(self, "places", places)
        object.__setattr__(self, "_padded", padded)  # which `to` moves
        check_number("clearance", self.clearance)  # metres

    def of_episode(self, observation: Observation, generator: np.random.Generator) -> Task:
        """This task with the places of an episode.

        Raises ValueError: there are more or fewer places than objects, or no room for random ones.
        """
        objects = int(observation.mask.sum())
        if not self.places:
            return replace(self, places=sample_places(self.region, objects, self.clearance, generator))
        if len(self.places) != objects:
            count = len(self.places)
            raise ValueError(f"task.places: number of places is {count}, of objects {objects}: use objects={count}")
        return self

    def goals(self) -> NDArray[np.float64]:
        """The places."""
        return np.array(self.places).reshape(-1, 2)

    def moved(self, goals: NDArray[np.float64], target: Place) -> Rearrange:
        """See `Task`: to any points on the table."""
        return replace(self, places=goals.tolist())

    def object_places(self) -> tuple[Place, ...]:
        """The places, in the order of objects."""
        return tuple(self.places)

    def distances(self, positions: Tensor) -> Tensor:
        """Metres from each object at `positions: [..., M, 2]` to its place: [..., M]."""
        padded: Tensor = vars(self)["_padded"]
        return (positions - padded[: positions.shape[-2]].to(positions)).norm(dim=-1)

    def success(self, step: Step) -> Tensor:
        """Every object is within the tolerance of its place: [...] bool."""
        tolerance = max(TOLERANCE - step.margin, LEAST_TOLERANCE)
        return ((self.distances(step.after) <= tolerance) | ~step.mask).all(dim=-1)

    def dead_end(self, step: Step) -> Tensor:
        """An object is pushed out of the tool's reach away from its place: [...] bool."""
        return step.any_leaves_reach(lambda points: self.distances(points) <= TOLERANCE)

    def potential(self, positions: Tensor, mask: Tensor) -> Tensor:
        """Minus the sum, over objects, of the distance to the object's place."""
        return -torch.where(mask, self.distances(positions), 0.0).sum(dim=-1)


def sample_places(
    region: Iterable[Tile], count: int, clearance: float, generator: np.random.Generator
) -> tuple[Place, ...]:
    """Places (x, y) in metres, uniform on some tiles, no two closer than `clearance` metres.

    Raises ValueError: the region is too small for so many.
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


def _places(given: Any) -> tuple[Place, ...]:
    """Check places from Python or YAML. Raises ValueError: they are no points on the table, or too many."""
    try:
        points = np.array(given, dtype=np.float64).reshape(len(given), 2)
    except (TypeError, ValueError) as error:
        raise ValueError(f"places must be points in metres such as [[0.5, 0.1], [0.4, -0.2]], not {given!r}") from error
    if len(points) > MAXIMUM_OBJECTS:
        raise ValueError(f"places must be at most {MAXIMUM_OBJECTS} points, not {len(points)}")
    for point in points.tolist():
        if not all(low < value < high for low, value, high in zip(TABLE_LOW, point, TABLE_HIGH, strict=True)):
            raise ValueError(f"places: {point} is off the table, from {list(TABLE_LOW)} to {list(TABLE_HIGH)}")
    return tuple((x, y) for x, y in points.tolist())
