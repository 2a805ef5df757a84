"""The parts of the world from the options `env.*`."""

from __future__ import annotations

from typing import Any

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.own_parts import object_set_of, robot_of
from envs.layouts import task_class
from envs.objects.object_sets import chosen, plain_name
from envs.objects.sampling import ObjectRanges
from envs.tasks import Task
from envs.workspace import MAXIMUM_MOTION, REACH_HIGH, REACH_LOW
from planning import PushBox

LIMITS = {  # of ranges; what lies beyond is a slip, with which no scene comes to rest
    "scale": (0.1, 10.0),
    "mass": (0.001, 1000.0),
    "friction": (0.001, 10.0),
    "kilograms": (0.001, 1000.0),
}


def task_of(config: DictConfig) -> tuple[type[Task], dict[str, Any]]:
    """The class that the option `task` names, and replacements of fields of its layout: `task.*` and `tiles.*`.

    Raises:
        UserError: there is no such class, or it is no task.
    """
    fields: Any = OmegaConf.to_container(config.tiles)
    if isinstance(config.task, str):
        with user_input():
            return task_class(config.task), fields
    section: Any = OmegaConf.to_container(config.task)
    target = section.pop("_target_", None)
    try:
        kind = hydra.utils.get_class(target)
    except (HydraException, ImportError, ValueError, TypeError) as error:
        raise UserError(f"task._target_={target} cannot be imported: {' '.join(str(error).split())}") from error
    if not issubclass(kind, Task):
        raise UserError(f"task._target_={target} is no task: derive it from envs.tasks.Task")
    return kind, fields | {name: value for name, value in section.items() if value is not None}


def check_world(env: DictConfig) -> None:
    """Check the names of the parts.

    Raises:
        UserError: an unknown part, with the valid ones, or missing files, with the command that gets them.
    """
    with user_input():
        robot_of(env.robot, env.assets)


def object_ranges(env: DictConfig) -> ObjectRanges:
    """Object parameters' ranges.

    Raises:
        UserError: assets that are not there, an unknown object, or a range that is not two increasing numbers within
            `LIMITS`.
    """
    ranges: Any = OmegaConf.to_container(env.ranges)
    with user_input():
        objects = object_set_of(env.objects, env.assets)
    every = tuple(dict.fromkeys(map(plain_name, objects.names)))
    for name in ("names", "target"):
        if not isinstance(ranges[name], list | None):
            raise UserError(f"env.ranges.{name} must be a list of objects, not {ranges[name]}")
        if name == "names" and ranges[name] == []:
            raise UserError(f"env.ranges.names must name an object, or be null for all: choose from {', '.join(every)}")
        ranges[name] = tuple(ranges[name] or (every if name == "names" else ()))
        try:
            chosen(ranges[name], objects)
        except ValueError as error:
            raise UserError(str(error).replace(":", f" in env.ranges.{name}:", 1)) from error
    for name in LIMITS:
        ranges[name] = _pair(f"env.ranges.{name}", ranges[name]) if ranges[name] or name != "kilograms" else None
    for name in ("clearance", "drop_height"):
        if not isinstance(ranges[name], int | float) or not ranges[name] >= 0:
            raise UserError(f"env.ranges.{name} must be at least 0 metres, not {ranges[name]}")
    return ObjectRanges(**ranges)


def _pair(name: str, value: Any) -> tuple[float, float]:
    numbers = isinstance(value, list) and len(value) == 2 and all(isinstance(end, int | float) for end in value)
    if not numbers or not 0 < value[0] <= value[1]:
        raise UserError(f"{name} must be two positive numbers, low then high, not {value}")
    least, most = LIMITS[name.rpartition(".")[2]]
    if value[0] < least or value[1] > most:
        raise UserError(f"{name} must be between {least:g} and {most:g}, not {value}")
    return value[0], value[1]


def push_box() -> PushBox:
    """The scale of normalised pushes, for planners that propose pushes near objects."""
    return PushBox(REACH_LOW, REACH_HIGH, MAXIMUM_MOTION)
