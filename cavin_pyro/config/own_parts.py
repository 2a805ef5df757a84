"""Classes of the user's own in the place of parts of the world: robot, objects, camera and segmentation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import construct, naming
from envs.objects.object_sets import ObjectSet, load_object_set
from envs.robots import Robot, RobotFactory, robot_factory
from envs.segmentation import Segmenter, SegmenterFactory
from envs.sensors import DepthSensor

Named = str | Mapping[str, Any] | DictConfig
"""The value of an option: a name of ours, or a section with `_target_`, a class of the user's, and its options."""


def plain(value: Named) -> str | dict[str, Any]:
    """The value without the types of configurations, for files and other processes."""
    return value if isinstance(value, str) else _section(value)


def own_class(value: Named) -> str:
    """The name of a part of ours, or the dotted path of a class of the user's."""
    return value if isinstance(value, str) else str(value.get("_target_"))


def robot_of(value: Named, assets: str | Path | None = None) -> RobotFactory:
    """The factory of the robot `env.robot`; a class of the user's gets the world (`envs.physics.PhysicsWorld`).

    Raises:
        ValueError: as `envs.robots.robot_factory`.
    """
    return robot_factory(_checked(value, "robot", Robot), assets)


def camera_of(value: Named) -> str | DepthSensor:
    """The sensor `env.camera`, or its name.

    Raises:
        UserError: a class that cannot be built, or is no sensor.
    """
    made: str | Callable[[], DepthSensor] = _checked(value, "camera", DepthSensor)
    return made if isinstance(made, str) else made()


def segmentation_of(value: Named) -> str | SegmenterFactory:
    """The factory of segmenters `env.segmentation`, or a name; a class of the user's gets M, the most objects."""
    return _checked(value, "segmentation", Segmenter)


def object_set_of(value: Named, assets: str | Path | None = None) -> ObjectSet:
    """The object set `env.objects`.

    Raises:
        UserError: a class that cannot be built, or is no object set.
        ValueError: as `envs.objects.object_sets.load_object_set`.
    """
    made: str | Callable[[], ObjectSet] = _checked(value, "objects", ObjectSet)
    return load_object_set(made if isinstance(made, str) else made(), assets)


def _checked(value: Named, part: str, protocol: type) -> Any:
    """A name as it is; else a function that builds the class, and raises a `UserError` for what is no such part."""
    return value if isinstance(value, str) else partial(_made, _section(value), f"env.{part}", protocol)


def _section(value: Mapping[str, Any] | DictConfig) -> dict[str, Any]:
    section: Any = OmegaConf.to_container(OmegaConf.create(dict(value)))
    return dict(section)


def _made(section: Mapping[str, Any], name: str, protocol: type, *arguments: Any) -> Any:
    target = str(section.get("_target_"))
    try:
        with naming(name, section):
            made = construct(section, *arguments)
    except UserError as error:
        raise UserError(str(error).replace(target, f"{name}._target_={target}", 1)) from error
    wanted = [member for member in {**vars(protocol), **protocol.__annotations__} if not member.startswith("_")]
    if lacking := [member for member in wanted if not hasattr(made, member)]:
        raise UserError(
            f"{name}._target_={target} is no {protocol.__name__}: it lacks {', '.join(lacking)} "
            f"({protocol.__module__}.{protocol.__name__})"
        )
    return made
