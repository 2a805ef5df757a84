"""The parts of the world from the options `task`, `tiles` and `env.*`: names of ours, or classes of the user's own."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.parts import construct
from cavin_pyro.envs.tabletop.layouts import task_class
from cavin_pyro.envs.tabletop.objects.object_sets import chosen, load_object_set, plain_name
from cavin_pyro.envs.tabletop.objects.sampling import ObjectRanges
from cavin_pyro.envs.tabletop.robots import robot_factory
from cavin_pyro.envs.tabletop.tasks import Task
from cavin_pyro.envs.world import World, check_world

Named = str | Mapping[str, Any] | DictConfig
"""The value of an option: a name of ours, or a section with `_target_`, a class of the user's, and its options."""


def task_of(config: DictConfig) -> tuple[type[Task], dict[str, Any]]:
    """The class that the option `task` names, and replacements of fields of its layout: `task.*` and `tiles.*`.

    A class that is not there, or that is no task, is a `UserError`.
    """
    tiles: Any = OmegaConf.to_container(config.tiles)
    with user_input("task"):
        if isinstance(config.task, str):
            return task_class(config.task), tiles
        section: Any = OmegaConf.to_container(config.task)
        kind = get_class(section.pop("_target_"))
        if not issubclass(kind, Task):
            raise ValueError(f"{kind.__name__} is no task: derive it from cavin_pyro.envs.tabletop.tasks.Task")
    return kind, tiles | {name: value for name, value in section.items() if value is not None}


def world_of(config: Mapping[str, Any] | DictConfig) -> World | None:
    """The world of the section `world`; None for the tabletop. One that is no `World` is a `UserError`."""
    section = dict(config.get("world") or {})
    if not section.get("_target_"):
        return None
    with user_input("env"):
        world: World = construct(section, kind=World)
        check_world(world)
    return world


def object_ranges(env: DictConfig) -> ObjectRanges:
    """Object parameters' ranges; an unknown object, or a range out of its limits, is a `UserError`."""
    ranges: Any = OmegaConf.to_container(env.ranges)
    objects = part_of("objects", env.objects, env.assets)
    every = tuple(dict.fromkeys(map(plain_name, objects.names)))
    if ranges["names"] == []:
        raise UserError(f"env.ranges.names must name an object, or be null for all: choose from {', '.join(every)}")
    for name, usual in (("names", every), ("target", ())):
        ranges[name] = tuple(ranges[name] or usual)
        with user_input(where=f"env.ranges.{name}"):
            chosen(ranges[name], objects)
    with user_input("env"):
        return ObjectRanges(**ranges)


def part_of(name: str, value: Named, assets: str | Path | None = None) -> Any:
    """The part of the world that the option `env.<name>` names, ready for `PushingEnv`.

    An object set or a sensor of the user's is built; of robots and segmenters it is a factory, which gets
    the `PhysicsWorld` or M, the most objects. A name of a camera or of a segmentation stays one.
    An unknown name, missing files, or a class that cannot be built is a `UserError`.
    """
    made: Any = value if isinstance(value, str) else partial(construct, dict(value))
    with user_input(f"env.{name}"):
        if name in ("objects", "camera") and not isinstance(made, str):
            made = made()
        if name == "robot":
            return robot_factory(made, assets)
        return load_object_set(made, assets) if name == "objects" else made
