"""One push, the same for every robot: above the start, down, straight, up, retract; and the wait afterwards.

Source: paper section 4.1 (position control, straight pushes) and the published implementation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from envs.physics import PhysicsWorld
from envs.robots.robot import ABOVE_HEIGHT, TIP_HEIGHT, Robot, Stopped

Ended = Stopped | Literal["unsafe"]
"""How a push ended: as `Stopped`, or not begun because the tool would have touched down on an object."""

SETTLED_SPEED = 0.01  # metres per second
SETTLING_STEPS = 20  # physics steps between two checks of the objects' speed


def push(robot: Robot, start: NDArray[np.float64], end: NDArray[np.float64]) -> Ended:
    """Execute one push and leave the view. If the push is stopped, the tool goes up and is retracted.

    Args:
        start, end: [2] metres, where the tip touches down and where it leaves the table.

    Returns:
        Why the push ended early, "" if it did not. An unsafe or unreachable push is not begun.
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
