"""The seam between the world and what pushes in it: what the driver of a real arm has to offer, and nothing more.

A driver implements `Robot` and enters its name in `envs.robots.ROBOTS`; `envs.robots.phases.push` then makes it push.
All places are those of the tool's tip, (x, y, z) metres in the robot's base frame with the table's top at z = 0, and
the tool stands upright. No method raises for what happens on the table: it reports, and leaves the robot stopped.
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

"": it did not. "unreachable": some place along it is out of reach; nothing moved. "blocked": the tip fell behind where
it should be by more than the robot tolerates, so that something is in the way. "table": the robot touched the table.
"""


class Robot(Protocol):
    """Something that holds a stick upright and pushes with it. Between pushes it is off stage."""

    def fits(self, place: Point) -> bool:
        """Whether the stick, upright with its tip at `place` [3], would cut into no object.

        A robot that cannot know says yes, and finds out on its way down.
        """

    def reaches(self, start: Point, end: Point) -> bool:
        """Whether the whole push is possible: from above `start` [3], along the line, to above `end` [3]."""

    def move(self, place: Point) -> Stopped:
        """Take the tip to `place` [3] at any pace: straight up or down if it lies over or under the tip."""

    def slide(self, end: Point) -> Stopped:
        """Push: take the tip to `end` [3] along a straight line, with a speed that rises from zero and ends there."""

    def leave(self) -> Stopped:
        """Take everything out of the camera's view, well above the objects."""

    def clear_of_view(self, camera: Camera) -> bool:
        """Whether no part of the robot stands between the camera and the table."""

    def stop(self) -> None:
        """Stand still from now on, wherever the robot is."""

    def wait(self) -> None:
        """Let one time step of the world pass, standing still."""

    def tip(self) -> Point:
        """Where the tip is now: [3] metres."""
