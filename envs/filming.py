"""The timing of frames in a video of pushes."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

from envs.robots import TIP_HEIGHT, Robot

FRAME_STEPS = 10  # physics steps between two frames of a video
TRAVEL_FRAME_STEPS = 40  # the same while the tool is in the air; an arm travels four fifths of the time

FrameHook = Callable[[], None]
"""Called a few times during a push, to film it."""


def film(robot: Robot, on_frame: FrameHook) -> Callable[[], None]:
    """A callback for the world after each step of a push; it makes the first step and every `FRAME_STEPS`th a frame."""
    steps = count()

    def after_step() -> None:
        number = next(steps)
        if number % FRAME_STEPS == 0:
            low = robot.tip()[2] < 2 * TIP_HEIGHT
            if low or number % TRAVEL_FRAME_STEPS == 0:
                on_frame()

    return after_step
