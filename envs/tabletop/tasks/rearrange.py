"""Rearranging: each object has to reach a place of its own, from a file or at random. Not in the paper."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cavin_pyro.envs.tabletop.goals import Goal, assign, read_goal, sample_places
from cavin_pyro.envs.tabletop.markings import Place, TileGroup
from cavin_pyro.envs.tabletop.observation import Observation
from cavin_pyro.envs.tabletop.tasks.task import Marking, Step, Task
from cavin_pyro.envs.tabletop.tasks.tiles import TileSet
from cavin_pyro.envs.tabletop.workspace import MAXIMUM_OBJECTS, TABLE_HIGH, TABLE_LOW

TOLERANCE = 0.03  # metres between an object's centre and its place, on the table, at most
LEAST_TOLERANCE = 0.01  # metres; a planner's margin leaves at least this


@dataclass(frozen=True, kw_only=True)
class Rearrange(Task):
    """Push every object to its place, in any order. Only falls off the table are forbidden.

    Places are for centres as observed: the mean of an object's visible points. Orientations do not count. Places in a
    file are assigned once, when the episode starts (`assign`); a random goal samples a place for each object.

    A margin makes the tolerance smaller for planners, and keeps objects within reach until they have arrived.

    Attributes:
        region: the tiles on which random places lie.
        goal: a file, see `read_goal`; None samples places in every episode, with the start's clearance.
        clearance: metres between random places, at least.
        places: (x, y) metres of each object, in order, instead of `goal`. Episodes have it.
    """

    markings = (Marking("region", "region of places", "#F2C200", 0.12),)
    about = "all"
    goal_varies = True
    goal_is_shared = False

    region: TileSet
    goal: str | None = None
    clearance: float = 0.15
    places: Sequence[Place] = ()

    def check(self) -> None:
        """The places are on the table, or the file shows some."""
        places = _places(self.places)
        object.__setattr__(self, "places", places)
        if places and self.goal is not None:
            raise ValueError(f"goal {self.goal} and places both say where the objects go: give one of them")
        if not (isinstance(self.clearance, int | float) and self.clearance >= 0.0):
            raise ValueError(f"clearance must be at least 0 metres, not {self.clearance!r}")
        if not places:
            _ = self._shown  # a bad file fails now

    @cached_property
    def _shown(self) -> Goal | None:
        """What the file shows, None without a file."""
        return None if self.goal is None else read_goal(self.goal)

    @cached_property
    def _padded(self) -> Tensor:
        """The places, padded: [MAXIMUM_OBJECTS, 2] metres."""
        padded = torch.zeros(MAXIMUM_OBJECTS, 2, dtype=torch.float64)
        padded[: len(self.places)] = torch.tensor(self.places, dtype=torch.float64).reshape(-1, 2)
        return padded

    def of_episode(self, observation: Observation, generator: np.random.Generator) -> Task:
        """This task with the places of an episode.

        Raises:
            ValueError: there are more or fewer places than objects, or no room for random ones.
        """
        objects = int(observation.mask.sum())
        if self.places:
            _check_count("task.places", len(self.places), objects)
            return self
        if self._shown is not None:
            _check_count(f"goal {self.goal}", len(self._shown.centers), objects)
            # Not by `replace`: nobody else may give places beside a file.
            episode = copy.copy(self)
            object.__setattr__(episode, "places", _places(assign(observation, self._shown)))
            vars(episode).pop("_padded", None)  # those of no places
            return episode
        return replace(self, places=sample_places(self.region, objects, self.clearance, generator))

    def to(self, device: torch.device) -> Rearrange:
        """As of `Task`, the places included."""
        _ = self._padded
        return super().to(device)

    def tile_groups(self) -> list[TileGroup]:
        """The region of random places; a file's places may lie anywhere."""
        return [] if self.goal else super().tile_groups()

    def object_places(self) -> tuple[Place, ...]:
        """The places, in the order of objects."""
        return tuple(self.places)

    def distances(self, positions: Tensor) -> Tensor:
        """Metres from each object at `positions: [..., M, 2]` to its place: [..., M]."""
        return (positions - self._padded[: positions.shape[-2]].to(positions)).norm(dim=-1)

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


def _places(given: Any) -> tuple[Place, ...]:
    """Check places from Python or YAML.

    Raises:
        ValueError: they are no points on the table, or too many.
    """
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


def _check_count(what: str, places: int, objects: int) -> None:
    if places != objects:
        raise ValueError(f"{what}: number of places is {places}, of objects {objects}: use objects={places}")
