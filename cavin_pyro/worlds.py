"""From the words `env.*` to the parts of the world."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, OmegaConf

from cavin_pyro.errors import UserError
from envs.objects import ObjectRanges
from envs.segmentation import SEGMENTERS
from envs.sensors import CAMERAS
from envs.shapes import BUILTIN_NAMES
from envs.workspace import MAXIMUM_MOTION, REACH_HIGH, REACH_LOW
from planning import PushBox

CHOICES = {
    "robot": ("stick",),
    "objects": ("builtin",),
    "camera": tuple(CAMERAS),
    "segmentation": tuple(SEGMENTERS),
}


def check_world(env: DictConfig) -> None:
    """Check the parts that have names.

    Raises:
        UserError: unknown part; the valid ones are named.
    """
    for word, valid in CHOICES.items():
        if env[word] not in valid:
            raise UserError(f"unknown env.{word} {env[word]!r}: choose from {', '.join(valid)}")


def object_ranges(env: DictConfig) -> ObjectRanges:
    """Object parameters' ranges.

    Raises:
        UserError: unknown shape, or a range that is not two increasing positive numbers.
    """
    ranges: Any = OmegaConf.to_container(env.ranges)
    names = ranges.pop("names") or BUILTIN_NAMES
    unknown = [name for name in names if name not in BUILTIN_NAMES]
    if unknown:
        raise UserError(f"unknown object {unknown[0]!r} in env.ranges.names: choose from {', '.join(BUILTIN_NAMES)}")
    for name in ("scale", "mass", "friction"):
        value = ranges[name]
        numbers = isinstance(value, list) and len(value) == 2 and all(isinstance(end, int | float) for end in value)
        if not numbers or not 0 < value[0] <= value[1]:
            raise UserError(f"env.ranges.{name} must be two positive numbers, low then high, not {value}")
    if not isinstance(ranges["clearance"], int | float) or not ranges["clearance"] >= 0:
        raise UserError(f"env.ranges.clearance must be at least 0 metres, not {ranges['clearance']}")
    scale, mass, friction = (tuple(ranges[name]) for name in ("scale", "mass", "friction"))
    return ObjectRanges(tuple(names), scale, mass, friction, ranges["clearance"])


def push_box() -> PushBox:
    """What normalised pushes mean on the table, for planners that propose pushes near objects."""
    return PushBox(REACH_LOW, REACH_HIGH, MAXIMUM_MOTION)
