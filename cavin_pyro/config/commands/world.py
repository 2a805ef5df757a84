"""The world of an episode: robot, objects, camera and segmentation, each by name or as a class of the user's own."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field
from typing import Any

from cavin_pyro.config.options import option
from envs.objects.sampling import ObjectRanges
from envs.pushing import PushingEnv

ENVIRONMENT = {name: one.default for name, one in inspect.signature(PushingEnv).parameters.items()}
COLLECTION_CLEARANCE = 0.12  # metres; collected scenes are denser than those of an episode


@dataclass
class RangesConfig:
    """Distributions of objects and their parameters (section `env.ranges`; presets `env/ranges=`)."""

    names: list[str] | None = option(None, "objects to sample from; by default all of env.objects")
    target: list[str] | None = option(None, "objects to sample the target from; by default those of names")
    scale: list[float] = option(list(ObjectRanges.scale), "factor on each object's size: low, high")
    mass: list[float] = option(list(ObjectRanges.mass), "factor on each object's own mass: low, high")
    kilograms: list[float] | None = option(
        None, "mass of every object in place of the factor: low, high", unit="kilograms"
    )
    friction: list[float] = option(list(ObjectRanges.friction), "Coulomb coefficient of friction: low, high")
    clearance: float = option(
        ObjectRanges.clearance, "least distance between the objects' centres at the start", unit="metres", minimum=0
    )
    drop_height: float = option(
        ObjectRanges.drop_height,
        "height above the table from which objects are dropped; 0 drops them from just above it",
        unit="metres",
        minimum=0,
        maximum=10,
    )


@dataclass
class WorldConfig:
    """The section `env`."""

    robot: Any = option(ENVIRONMENT["robot"], "robot that pushes", choices="envs.robots.ROBOTS")
    objects: Any = option(ENVIRONMENT["object_set"], "set of objects", choices="envs.objects.object_sets.OBJECT_SETS")
    camera: Any = option(ENVIRONMENT["camera"], "depth camera", choices="envs.sensors.CAMERAS")
    segmentation: Any = option(
        ENVIRONMENT["segmentation"],
        "segmentation of objects in a depth image",
        choices="envs.segmentation.SEGMENTERS",
    )
    assets: str | None = option(None, "folder of meshes, for object sets and robots that need one")
    ranges: RangesConfig = field(default_factory=RangesConfig)


def collection_world() -> WorldConfig:
    """The world for the collection of random pushes."""
    return WorldConfig(ranges=RangesConfig(clearance=COLLECTION_CLEARANCE))
