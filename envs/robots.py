"""What pushes: a stick that comes down, moves along a straight line and leaves the camera's view.

Source: paper section 4.1 (position control, straight pushes) and the published implementation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from envs.physics import TIME_STEP, PhysicsWorld

STICK_RADIUS = 0.01  # metres
STICK_LENGTH = 0.15  # metres
TIP_HEIGHT = 0.008  # metres above the table while pushing; lower than the flattest object is tall
OFF_STAGE = (0.60, 0.0, 2.0)  # metres; above the camera, so that no image shows the tool
PUSH_STEPS = 80  # physics steps for one push, a third of a second
SETTLED_SPEED = 0.01  # metres per second
SETTLING_STEPS = 20  # physics steps between two looks at the objects' speed

FrameHook = Callable[[], None]
"""Called a few times during a push, for whoever films it."""


class StickRobot:
    """The tool alone, moved kinematically: the fast robot.

    Its speed follows half a period of a sine, so that objects, whose friction can brake harder than the tool
    does, stop when the tool stops.
    """

    def __init__(self, world: PhysicsWorld) -> None:
        self._world = world
        self._tool = world.add_tool(radius=STICK_RADIUS, length=STICK_LENGTH, position=OFF_STAGE)

    def push(
        self,
        start: NDArray[np.float64],
        end: NDArray[np.float64],
        objects: Sequence[int],
        *,
        on_frame: FrameHook | None = None,
        frame_every: int = 10,
    ) -> bool:
        """Carry out one push and get out of view.

        A push that would bring the tool down on an object is not carried out.

        Args:
            start, end: [2] metres. objects: bodies that the tool must not come down on.
            on_frame: called every `frame_every` physics steps.

        Returns:
            Whether the push was safe, that is, carried out.
        """
        world, height = self._world, TIP_HEIGHT + STICK_LENGTH / 2
        world.place(self._tool, (*start, height), (0.0, 0.0, 0.0))
        safe = not any(world.overlaps(self._tool, body) for body in objects)
        if safe:
            phase = np.linspace(0.0, np.pi, PUSH_STEPS + 1)
            travelled = (1.0 - np.cos(phase)) / 2.0
            for number, (now, then) in enumerate(pairwise(travelled)):
                position = start + now * (end - start)
                velocity = (then - now) / TIME_STEP * (end - start)
                world.place(self._tool, (*position, height), (*velocity, 0.0))
                world.step()
                if on_frame is not None and number % frame_every == 0:
                    on_frame()
        world.place(self._tool, OFF_STAGE, (0.0, 0.0, 0.0))
        return safe

    def settle(self, objects: Sequence[int], *, limit: int = 240) -> None:
        """Wait off stage until the objects rest, at most `limit` physics steps; let them sleep if they do."""
        for number in range(limit):
            self._world.place(self._tool, OFF_STAGE, (0.0, 0.0, 0.0))
            self._world.step()
            if (number + 1) % SETTLING_STEPS == 0 and self._world.fastest(objects) < SETTLED_SPEED:
                self._world.rest(objects)
                break
