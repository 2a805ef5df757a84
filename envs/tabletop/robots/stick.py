"""The tool alone, moved kinematically: the fast robot."""

from __future__ import annotations

import numpy as np

from cavin_pyro.envs.tabletop.physics import TIME_STEP, PhysicsWorld
from cavin_pyro.envs.tabletop.robots.robot import PUSH_STEPS, STICK_LENGTH, STICK_RADIUS, Point, Stopped
from cavin_pyro.envs.tabletop.sensors.camera import Camera

RETRACTED = (0.60, 0.0, 2.0)  # metres, the tool's middle; above the camera, out of its view
_MIDDLE = STICK_LENGTH / 2  # metres above the tip


class StickRobot:
    """A stick with a prescribed pose; time passes only while it slides.

    Its speed follows half a period of a sine, so that objects, whose friction decelerates them faster than the tool
    does, stop when the tool stops. It reaches every position, and nothing stops it.
    """

    def __init__(self, world: PhysicsWorld) -> None:
        self._world = world
        self._tool = world.add_tool(radius=STICK_RADIUS, length=STICK_LENGTH, position=RETRACTED)
        self._tip = np.array(RETRACTED) - (0.0, 0.0, _MIDDLE)

    def fits(self, place: Point) -> bool:
        self._put(place, np.zeros(3))  # not `occupied`: Bullet's later contacts depend on where the tool has been
        return not any(self._world.overlaps(self._tool, body) for body in self._world.objects)

    def reaches(self, start: Point, end: Point) -> bool:
        return True

    def move(self, place: Point) -> Stopped:
        self._tip = place  # without passing time or touching anything
        return ""

    def slide(self, end: Point) -> Stopped:
        start, line = self._tip, end - self._tip
        travelled = (1.0 - np.cos(np.linspace(0.0, np.pi, PUSH_STEPS + 1))) / 2.0
        speeds = np.diff(travelled) / TIME_STEP
        for tip, velocity in zip(start + travelled[:-1, None] * line, speeds[:, None] * line, strict=True):
            self._put(tip, velocity)
            self._world.step()
        return self.move(end)

    def leave(self) -> Stopped:
        self._put(np.array(RETRACTED) - (0.0, 0.0, _MIDDLE), np.zeros(3))
        return ""

    def clear_of_view(self, camera: Camera) -> bool:
        return bool(self._tip[2] > camera.position[2])

    def stop(self) -> None:
        self._put(self._tip, np.zeros(3))

    def wait(self) -> None:
        self.stop()
        self._world.step()

    def tip(self) -> Point:
        return self._tip.copy()

    def _put(self, tip: Point, velocity: Point) -> None:
        self._tip = tip
        x, y, z = tip.tolist()
        self._world.place(self._tool, (x, y, z + _MIDDLE), velocity.tolist())
