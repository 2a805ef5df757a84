"""What pushes: a stick that moves by itself, or an arm that holds one. `Robot` is what a real arm would implement."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from envs.physics import PhysicsWorld
from envs.robots.arm import ArmRobot
from envs.robots.panda import panda
from envs.robots.phases import SETTLED_SPEED, push, settle
from envs.robots.robot import STICK_LENGTH, STICK_RADIUS, TIP_HEIGHT, Robot, Stopped
from envs.robots.sawyer import sawyer
from envs.robots.stick import OFF_STAGE, StickRobot

__all__ = [
    "OFF_STAGE",
    "ROBOTS",
    "SETTLED_SPEED",
    "STICK_LENGTH",
    "STICK_RADIUS",
    "TIP_HEIGHT",
    "ArmRobot",
    "Robot",
    "RobotMaker",
    "StickRobot",
    "Stopped",
    "push",
    "robot_maker",
    "settle",
]

RobotMaker = Callable[[PhysicsWorld], Robot]
"""Puts a robot into a world that was just emptied."""

# From the folder of assets, or None, to a maker. A robot that lacks something says so here, before any world is built.
ROBOTS: dict[str, Callable[[str | Path | None], RobotMaker]] = {
    "stick": lambda assets: StickRobot,
    "sawyer": lambda assets: partial(ArmRobot, description=sawyer(assets)),
    "panda": lambda assets: partial(ArmRobot, description=panda(assets)),
}


def robot_maker(name: str, assets: str | Path | None = None) -> RobotMaker:
    """What puts the robot of that name into a world.

    Raises:
        ValueError: unknown robot, or its files are missing; what to do stands in the message.
    """
    if name not in ROBOTS:
        raise ValueError(f"unknown robot {name!r}: choose from {', '.join(ROBOTS)}")
    return ROBOTS[name](assets)
