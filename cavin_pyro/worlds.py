"""From the words `env.*` to the parts of the world."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, OmegaConf

from cavin_pyro.collection import CollectionSettings
from cavin_pyro.errors import UserError, one_of, user_input
from envs.object_asset import plain_name
from envs.object_sets import OBJECT_SETS, chosen, load_object_set
from envs.objects import ObjectRanges
from envs.robots import ROBOTS, robot_maker
from envs.segmentation import SEGMENTERS
from envs.sensors import CAMERAS
from envs.workspace import MAXIMUM_MOTION, REACH_HIGH, REACH_LOW
from planning import PushBox

CHOICES = {
    "robot": tuple(ROBOTS),
    "objects": tuple(OBJECT_SETS),
    "camera": tuple(CAMERAS),
    "segmentation": tuple(SEGMENTERS),
}


def check_world(env: DictConfig) -> None:
    """Check the parts that have names.

    Raises:
        UserError: unknown part, the valid ones are named; or a part lacks files, and what to do is said.
    """
    for word, valid in CHOICES.items():
        one_of(f"env.{word}", env[word], valid)
    if env.assets is not None and not isinstance(env.assets, str):
        raise UserError(f"env.assets must be the path of a folder, not {env.assets!r}")
    with user_input():
        robot_maker(env.robot, env.assets)


def object_ranges(env: DictConfig) -> ObjectRanges:
    """Object parameters' ranges.

    Raises:
        UserError: assets that are not there, an unknown object, or a range that is not two increasing positive numbers.
    """
    ranges: Any = OmegaConf.to_container(env.ranges)
    with user_input():
        objects = load_object_set(env.objects, env.assets)
    every = tuple(dict.fromkeys(map(plain_name, objects.names)))
    for word in ("names", "target"):
        if not isinstance(ranges[word], list | None):
            raise UserError(f"env.ranges.{word} must be a list of objects, not {ranges[word]}")
        ranges[word] = tuple(ranges[word] or (every if word == "names" else ()))
        try:
            chosen(ranges[word], objects)
        except ValueError as error:
            raise UserError(str(error).replace(":", f" in env.ranges.{word}:", 1)) from error
    for word in ("scale", "mass", "friction", "kilograms"):
        ranges[word] = _pair(f"env.ranges.{word}", ranges[word]) if ranges[word] or word != "kilograms" else None
    for word in ("clearance", "drop_height"):
        if not isinstance(ranges[word], int | float) or not ranges[word] >= 0:
            raise UserError(f"env.ranges.{word} must be at least 0 metres, not {ranges[word]}")
    return ObjectRanges(**ranges)


def collecting_world(env: DictConfig) -> CollectionSettings:
    """How episodes are collected in the world of `env.*`, with the usual numbers.

    Raises:
        UserError: as `check_world` and `object_ranges`, or another robot than the stick.
    """
    check_world(env)
    if env.robot != "stick":
        raise UserError(f"random pushes are made with env.robot=stick, not {env.robot}: it pushes alike in less time")
    return CollectionSettings(
        ranges=object_ranges(env),
        object_set=env.objects,
        assets=env.assets,
        camera=env.camera,
        segmentation=env.segmentation,
    )


def _pair(word: str, value: Any) -> tuple[float, float]:
    numbers = isinstance(value, list) and len(value) == 2 and all(isinstance(end, int | float) for end in value)
    if not numbers or not 0 < value[0] <= value[1]:
        raise UserError(f"{word} must be two positive numbers, low then high, not {value}")
    return value[0], value[1]


def push_box() -> PushBox:
    """What normalised pushes mean on the table, for planners that propose pushes near objects."""
    return PushBox(REACH_LOW, REACH_HIGH, MAXIMUM_MOTION)
