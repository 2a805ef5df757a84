"""Robots: a stick that moves by itself, or an arm that holds one. A driver of a real arm implements `Robot`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from cavin_pyro.envs.tabletop.physics import PhysicsWorld
from cavin_pyro.envs.tabletop.robots.arm import ArmRobot
from cavin_pyro.envs.tabletop.robots.panda import panda
from cavin_pyro.envs.tabletop.robots.robot import Robot
from cavin_pyro.envs.tabletop.robots.sawyer import sawyer
from cavin_pyro.envs.tabletop.robots.stick import StickRobot
from cavin_pyro.models.checks import check_choice

RobotFactory = Callable[[PhysicsWorld], Robot]
"""Puts a robot into an empty world."""

# Functions from the folder of assets, or None, to a factory of robots. They raise if a file is missing, before a world
# is built.
ROBOTS: dict[str, Callable[[str | Path | None], RobotFactory]] = {
    "stick": lambda assets: StickRobot,
    "sawyer": lambda assets: partial(ArmRobot, description=sawyer(assets)),
    "panda": lambda assets: partial(ArmRobot, description=panda(assets)),
}


def robot_factory(robot: str | RobotFactory, assets: str | Path | None = None) -> RobotFactory:
    """The factory of the robot of that name, or the given one.

    Raises ValueError: unknown robot, or missing files; the message says how to get them.
    """
    if not isinstance(robot, str):
        return robot
    check_choice("robot", robot, ROBOTS)
    return ROBOTS[robot](assets)
