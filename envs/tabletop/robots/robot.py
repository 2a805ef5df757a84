"""The interface of robots, which the driver of a real arm implements.

`push` makes whatever implements `Robot` push: one of `ROBOTS`, or a class of the user's.
All places are those of the tool's tip, (x, y, z) metres in the robot's base frame with the table's top at z = 0, and
the tool stands upright. No method raises for an event on the table: it reports the event and stops the robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.physics import PhysicsWorld
from cavin_pyro.envs.tabletop.sensors.camera import Camera

STICK_RADIUS = 0.01  # metres
STICK_LENGTH = 0.15  # metres
TIP_HEIGHT = 0.008  # metres above the table while pushing; lower than the flattest object is tall
ABOVE_HEIGHT = 0.22  # metres above the table; higher than the tallest object standing, 0.175 m at scale 1.2
PUSH_STEPS = 80  # physics steps for one push, a third of a second

# The stick as links of an arm's URDF: a constraint between bodies would yield under load.
WEIGHTLESS = (  # a link without mass would weigh a kilogram in the simulator
    '<inertial><mass value="0.0001"/><inertia ixx="1e-8" iyy="1e-8" izz="1e-8" ixy="0" ixz="0" iyz="0"/></inertial>'
)
_ROD = (
    f'<origin xyz="0 0 {STICK_LENGTH / 2}"/>'
    f'<geometry><cylinder radius="{STICK_RADIUS}" length="{STICK_LENGTH}"/></geometry>'
)
STICK_URDF = f"""<stick>
<link name="stick">
<inertial><origin xyz="0 0 {STICK_LENGTH / 2}"/><mass value="0.1"/>
<inertia ixx="2e-4" iyy="2e-4" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>
<visual>{_ROD}</visual><collision>{_ROD}</collision></link>
<joint name="stick_fixed" type="fixed"><origin xyz="0 0 0"/><parent link="HAND"/><child link="stick"/></joint>
<link name="stick_tip">{WEIGHTLESS}</link>
<joint name="stick_tip_fixed" type="fixed"><origin xyz="0 0 {STICK_LENGTH}"/>
<parent link="stick"/><child link="stick_tip"/></joint>
</stick>"""

Point = NDArray[np.float64]
Stopped = Literal["", "unreachable", "blocked", "table"]
"""Why a motion ended early.

"": it did not. "unreachable": some position along it has no solution; nothing moved. "blocked": the tip's
error exceeds the robot's tolerance, so an obstacle is in the way. "table": the robot touched the table.
"""


class Robot(Protocol):
    """Holds a stick upright and pushes with it. Between pushes it is retracted, out of the camera's view."""

    def fits(self, place: Point) -> bool:
        """Whether the stick, upright with its tip at `place` [3], would overlap no object.

        A robot without this knowledge returns True; its way down may then be blocked.
        """

    def reaches(self, start: Point, end: Point) -> bool:
        """Whether the whole push is possible: from above `start` [3], along the line, to above `end` [3]."""

    def move(self, place: Point) -> Stopped:
        """Move the tip to `place` [3] at any speed: straight up or down if it is above or below the tip."""

    def slide(self, end: Point) -> Stopped:
        """Push: move the tip to `end` [3] along a straight line, with zero speed at both ends."""

    def leave(self) -> Stopped:
        """Leave the camera's view, well above the objects."""

    def clear_of_view(self, camera: Camera) -> bool:
        """Whether no part of the robot stands between the camera and the table."""

    def stop(self) -> None:
        """Stop at the current position."""

    def wait(self) -> None:
        """Wait for one time step of the world."""

    def tip(self) -> Point:
        """Current position of the tip: [3] metres."""


Ended = Stopped | Literal["unsafe"]
"""How a push ended: as `Stopped`, or not begun because the tool would have touched down on an object."""

SETTLED_SPEED = 0.01  # metres per second
SETTLING_STEPS = 20  # physics steps between two checks of the objects' speed


def push(robot: Robot, start: NDArray[np.float64], end: NDArray[np.float64]) -> Ended:
    """Execute one push and leave the view. If the push is stopped, the tool goes up and is retracted.

    `start`, `end`: [2] metres, where the tip touches down and where it leaves the table. Returns why the push ended
    early, "" if it did not. An unsafe or unreachable push is not begun.
    """
    low, above, last = np.append(start, TIP_HEIGHT), np.append(start, ABOVE_HEIGHT), np.append(end, TIP_HEIGHT)
    if not robot.fits(low):
        robot.leave()
        return "unsafe"
    if not robot.reaches(low, last):
        robot.leave()
        return "unreachable"
    stopped = robot.move(above) or robot.move(low) or robot.slide(last)
    if stopped:
        robot.stop()
    # Straight up from the current position; if even this fails, leave.
    robot.move(np.append(robot.tip()[:2] if stopped else end, ABOVE_HEIGHT))
    robot.leave()
    return stopped


def settle(world: PhysicsWorld, robot: Robot, objects: Sequence[int], *, limit: int = 240) -> None:
    """Wait until the objects rest, at most `limit` physics steps; put them to sleep if they do."""
    for number in range(limit):
        robot.wait()
        if (number + 1) % SETTLING_STEPS == 0 and world.fastest(objects) < SETTLED_SPEED:
            world.rest(objects)
            break
