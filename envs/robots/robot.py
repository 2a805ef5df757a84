"""The interface of robots, which the driver of a real arm implements.

`envs.robots.phases.push` makes whatever implements `Robot` push: one of `envs.robots.ROBOTS`, or a class of the user's.
All places are those of the tool's tip, (x, y, z) metres in the robot's base frame with the table's top at z = 0, and
the tool stands upright. No method raises for an event on the table: it reports the event and stops the robot.
"""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from envs.sensors.camera import Camera

STICK_RADIUS = 0.01  # metres
STICK_LENGTH = 0.15  # metres
TIP_HEIGHT = 0.008  # metres above the table while pushing; lower than the flattest object is tall
ABOVE_HEIGHT = 0.22  # metres above the table; higher than the tallest object standing, 0.175 m at scale 1.2
PUSH_STEPS = 80  # physics steps for one push, a third of a second

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
