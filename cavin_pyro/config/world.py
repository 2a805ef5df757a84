"""The parts of the world from the options `task`, `tiles` and `env.*`: names of ours, or classes of the user's own."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.errors import UserError, one_line, user_input
from cavin_pyro.config.parts import construct, naming
from envs.layouts import task_class
from envs.objects.object_sets import ObjectSet, chosen, load_object_set, plain_name
from envs.objects.sampling import ObjectRanges
from envs.robots import Robot, RobotFactory, robot_factory
from envs.segmentation import Segmenter, SegmenterFactory
from envs.sensors import DepthSensor
from envs.tasks import Task

LIMITS = {  # of ranges; what lies beyond is a slip, with which no scene comes to rest
    "scale": (0.1, 10.0),
    "mass": (0.001, 1000.0),
    "friction": (0.001, 10.0),
    "kilograms": (0.001, 1000.0),
}
Named = str | Mapping[str, Any] | DictConfig
"""The value of an option: a name of ours, or a section with `_target_`, a class of the user's, and its options."""


def task_of(config: DictConfig) -> tuple[type[Task], dict[str, Any]]:
    """The class that the option `task` names, and replacements of fields of its layout: `task.*` and `tiles.*`.

    Raises:
        UserError: there is no such class, or it is no task.
    """
    tiles: Any = OmegaConf.to_container(config.tiles)
    if isinstance(config.task, str):
        with user_input():
            return task_class(config.task), tiles
    section: Any = OmegaConf.to_container(config.task)
    target = section.pop("_target_", None)
    try:
        kind = get_class(target)
    except Exception as error:
        raise UserError(f"task._target_={target} cannot be imported: {one_line(error)}") from error
    if not issubclass(kind, Task):
        raise UserError(f"task._target_={target} is no task: derive it from envs.tasks.Task")
    return kind, tiles | {name: value for name, value in section.items() if value is not None}


def object_ranges(env: DictConfig) -> ObjectRanges:
    """Object parameters' ranges.

    Raises:
        UserError: assets that are not there, an unknown object, or a range that is not two increasing numbers within
            `LIMITS`.
    """
    ranges: Any = OmegaConf.to_container(env.ranges)
    objects = object_set_of(env.objects, env.assets)
    every = tuple(dict.fromkeys(map(plain_name, objects.names)))
    if ranges["names"] == []:
        raise UserError(f"env.ranges.names must name an object, or be null for all: choose from {', '.join(every)}")
    for name, usual in (("names", every), ("target", ())):
        ranges[name] = tuple(ranges[name] or usual)
        try:
            chosen(ranges[name], objects)
        except ValueError as error:
            raise UserError(str(error).replace(":", f" in env.ranges.{name}:", 1)) from error
    for name, (least, most) in LIMITS.items():
        given = ranges[name]
        if given is None:
            continue
        if len(given) != 2 or not least <= given[0] <= given[1] <= most:
            raise UserError(f"env.ranges.{name} must be low, then high, between {least:g} and {most:g}, not {given}")
        ranges[name] = tuple(given)
    return ObjectRanges(**ranges)


def plain(value: Named) -> str | dict[str, Any]:
    """The value without the types of configurations, for files and other processes."""
    section: Any = value if isinstance(value, str) else OmegaConf.to_container(OmegaConf.create(dict(value)))
    return section if isinstance(section, str) else dict(section)


def robot_of(value: Named, assets: str | Path | None = None) -> RobotFactory:
    """The factory of the robot `env.robot`; a class of the user's gets the world (`envs.physics.PhysicsWorld`).

    Raises:
        UserError: unknown robot, or missing files; the message says how to get them.
    """
    with user_input():
        return robot_factory(_checked(value, "robot", Robot), assets)


def camera_of(value: Named) -> str | DepthSensor:
    """The sensor `env.camera`, or its name.

    Raises:
        UserError: a class that cannot be built, or is no sensor.
    """
    made = _checked(value, "camera", DepthSensor)
    return made if isinstance(made, str) else made()


def segmentation_of(value: Named) -> str | SegmenterFactory:
    """The factory of segmenters `env.segmentation`, or a name; a class of the user's gets M, the most objects."""
    return _checked(value, "segmentation", Segmenter)


def object_set_of(value: Named, assets: str | Path | None = None) -> ObjectSet:
    """The object set `env.objects`.

    Raises:
        UserError: a class that cannot be built or is no object set, or missing files.
    """
    made = _checked(value, "objects", ObjectSet)
    with user_input():
        return load_object_set(made if isinstance(made, str) else made(), assets)


def _checked(value: Named, part: str, protocol: type) -> Any:
    """A name as it is; else a function that builds the class, and raises a `UserError` for what is no such part."""
    return value if isinstance(value, str) else partial(_made, dict(value), f"env.{part}", protocol)


def _made(section: Mapping[str, Any], name: str, protocol: type, *arguments: Any) -> Any:
    with naming(name, section):
        made = construct(section, *arguments)
    wanted = [member for member in {**vars(protocol), **protocol.__annotations__} if not member.startswith("_")]
    if lacking := [member for member in wanted if not hasattr(made, member)]:
        raise UserError(
            f"{name}._target_={section['_target_']} is no {protocol.__name__}: it lacks {', '.join(lacking)} "
            f"({protocol.__module__}.{protocol.__name__})"
        )
    return made
