"""A simulated arm of seven joints: inverse kinematics at waypoints, motors that follow the path between them.

The stick is round and upright, so its rotation about its own axis is free: there are five conditions, and an arm of
seven joints has two redundant degrees of freedom, which keep it near a posture. The first joint turns the whole arm
about the vertical, so a table over distance and height gives an initial guess for every position, which damped least
squares refines. The solution depends on the position only, not on the arm's state: equal pushes are executed equally.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, RegularGridInterpolator

from cavin_pyro.envs.tabletop.physics import TIME_STEP, Arm, ArmDescription, Kinematics, PhysicsWorld
from cavin_pyro.envs.tabletop.robots.robot import (
    ABOVE_HEIGHT,
    PUSH_STEPS,
    STICK_LENGTH,
    STICK_RADIUS,
    TIP_HEIGHT,
    Point,
    Stopped,
)
from cavin_pyro.envs.tabletop.sensors.camera import Camera
from cavin_pyro.envs.tabletop.workspace import TABLE_HIGH, TABLE_LOW

DISTANCES = np.arange(0.20, 1.001, 0.05)  # metres from the first joint's axis
HEIGHTS = np.linspace(TIP_HEIGHT, ABOVE_HEIGHT, 4)  # metres
CLOSE = 1e-4  # tolerance: metres from the position, and radians from upright
ITERATIONS = 60
DAMPING = 1e-5
TO_POSTURE = 0.1  # fraction of the way back to the posture per iteration, in the null space of the tip
LARGEST_STEP = 0.3  # radians per iteration


class InverseKinematics:
    """Joint angles for positions of the tip. Raises ValueError: the arm's file cannot be used."""

    def __init__(self, description: ArmDescription) -> None:
        self.forward = Kinematics(description)
        self._base, self._posture = np.array(description.base), np.array(description.posture)
        self.solve = lru_cache(maxsize=4096)(self._solve)
        # Outwards and inwards from the middle, each from its neighbour, so that the elbow does not flip.
        middle = len(DISTANCES) // 2
        table = np.zeros((len(DISTANCES), len(HEIGHTS), len(self._posture)))
        for column, height in enumerate(HEIGHTS):
            for rows in (range(middle, len(DISTANCES)), range(middle - 1, -1, -1)):
                for row in rows:
                    near = row - rows.step
                    guess = table[near, column] if row != middle else self._posture
                    place = self._base + np.array([DISTANCES[row], 0.0, height - self._base[2]])
                    table[row, column] = self._descend(place, guess, TO_POSTURE)[0]
        self._guess = RegularGridInterpolator((DISTANCES, HEIGHTS), table, bounds_error=False, fill_value=None)

    def angles(self, place: Point) -> NDArray[np.float64] | None:
        """Joint angles [J] radians that put the tip at `place` [3] metres, upright; None if there is no solution."""
        return self.solve(*(float(value) for value in place))

    def _solve(self, x: float, y: float, z: float) -> NDArray[np.float64] | None:
        place = np.array([x, y, z])
        if not np.isfinite(place).all():
            return None
        across = place[:2] - self._base[:2]
        guess = self._guess((np.clip(np.linalg.norm(across), DISTANCES[0], DISTANCES[-1]), z))
        guess = np.clip(guess.reshape(-1), self.forward.low, self.forward.high)
        guess[0] += np.arctan2(across[1], across[0])
        angles, there = self._descend(place, guess, 0.0)
        return angles if there else None

    def _descend(self, place: Point, angles: NDArray[np.float64], drift: float) -> tuple[NDArray[np.float64], bool]:
        """Damped least squares from a guess, within the joints' limits: angles [J], and whether they converged."""
        for _ in range(ITERATIONS):
            position, axis, jacobian = self.forward(angles)
            # The rotation that makes the axis point down; its component about the vertical is free.
            error = np.concatenate([place - position, np.cross(axis, (0.0, 0.0, -1.0))[:2]])
            if np.abs(error).max() < CLOSE and axis[2] < 0.0:
                return angles, True
            jacobian = jacobian[:5]
            inverse = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + DAMPING * np.eye(5))
            step = inverse @ error
            if drift:
                step += (np.eye(len(angles)) - inverse @ jacobian) @ (drift * (self._posture - angles))
            step *= min(1.0, LARGEST_STEP / max(float(np.abs(step).max()), 1e-9))
            angles = np.clip(angles + step, self.forward.low, self.forward.high)
        return angles, False


WAYPOINTS = 11  # along a push, at most 14 mm apart
WAYPOINTS_UP = 5  # between the table and `ABOVE_HEIGHT`
MOVE_STEPS = 40  # physics steps, at least, for any motion that does not push
LARGEST_GAP = 0.6  # radians between neighbouring waypoints; a larger gap makes a path invalid
BEHIND = 0.02  # radians of a joint's error above which the arm counts as blocked

# One for each arm and process: its construction takes a fifth of a second, and it does not depend on a world.
inverse_kinematics = lru_cache(maxsize=None)(InverseKinematics)


class ArmRobot:
    """An arm, which waits retracted, out of the camera's view, between pushes.

    A push has the stick's number of physics steps and speed profile, or more steps if a joint would exceed its
    velocity limit. All other motions are as fast as the joints allow. Raises ValueError: the arm's file cannot be used.
    """

    def __init__(self, world: PhysicsWorld, description: ArmDescription) -> None:
        self.inverse = inverse_kinematics(description)
        self._world, self.arm = world, Arm(world, description)
        self._home = self._at = self.arm.angles()  # commanded joint angles
        self._place = self.arm.tip()  # commanded position of the tip

    def fits(self, place: Point) -> bool:
        return not self._world.occupied(place, radius=STICK_RADIUS, length=STICK_LENGTH)

    def reaches(self, start: Point, end: Point) -> bool:
        columns = [_line(np.append(place[:2], ABOVE_HEIGHT), place, WAYPOINTS_UP) for place in (start, end)]
        paths = [self._angles(places) for places in (*columns, _line(start, end, WAYPOINTS))]
        return all(path is not None for path in paths)

    def move(self, place: Point) -> Stopped:
        if np.allclose(place[:2], self._place[:2]):
            path = self._angles(_line(self._place, place, WAYPOINTS_UP))
        else:
            angles = self.inverse.angles(place)
            path = None if angles is None else np.stack([self._at, angles])
        return self._follow(path, place, MOVE_STEPS)

    def slide(self, end: Point) -> Stopped:
        return self._follow(self._angles(_line(self._place, end, WAYPOINTS)), end, PUSH_STEPS)

    def leave(self) -> Stopped:
        if self._at is self._home:
            return ""
        stopped = self._follow(np.stack([self._at, self._home]), self.arm.tip(), MOVE_STEPS, guarded=False)
        if np.abs(self.arm.angles() - self._home).max() > BEHIND:
            self.arm.lift_out()  # stuck; a real arm needs help here
        self._at, self._place = self._home, self.arm.tip()
        return stopped

    def clear_of_view(self, camera: Camera) -> bool:
        x, y, z = camera.position
        corners = self.arm.corners()
        # Project the arm from the camera onto the table; parts above the camera do not count.
        depth = z - corners[..., 2:]
        below = (depth > 0.0).any(axis=(1, 2))
        shadow = (corners[below, :, :2] - (x, y)) * z / np.maximum(depth[below], 1e-3) + (x, y)
        apart = (shadow.max(axis=1) < TABLE_LOW) | (shadow.min(axis=1) > TABLE_HIGH)
        return bool(apart.any(axis=1).all())

    def stop(self) -> None:
        self._at, self._place = self.arm.angles(), self.arm.tip()
        self.arm.command(self._at, np.zeros_like(self._at))

    def wait(self) -> None:
        self._world.step()

    def tip(self) -> Point:
        return self.arm.tip()

    def _angles(self, places: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Joint angles [K, J] for places [K, 3], or None where there is no smooth path through them."""
        found = [self.inverse.angles(place) for place in places]
        path = [angles for angles in found if angles is not None]
        if len(path) < len(found) or np.abs(np.diff(path, axis=0)).max() > LARGEST_GAP:
            return None
        return np.stack(path)

    def _follow(self, path: NDArray[np.float64] | None, place: Point, steps: int, *, guarded: bool = True) -> Stopped:
        """Drive the joints along waypoints [K, J], evenly spaced along the path, in at least `steps` steps."""
        if path is None:
            return "unreachable"
        spline = CubicSpline(np.linspace(0.0, 1.0, len(path)), path)  # of two waypoints, a straight line
        slope = np.abs(np.diff(spline(np.linspace(0.0, 1.0, 50)), axis=0)).max(axis=0) * 49
        # The peak of the profile below is pi / 2 times its mean.
        needed = float((slope / self.inverse.forward.fastest).max()) * np.pi / 2 / TIME_STEP
        phase = np.linspace(0.0, np.pi, max(steps, int(np.ceil(needed))) + 1)
        for now, then in pairwise(spline((1.0 - np.cos(phase)) / 2.0)):
            self.arm.command(now, (then - now) / TIME_STEP)
            self._world.step()
            if guarded:
                behind = np.abs(self.arm.angles() - then).max() > BEHIND
                stopped: Stopped = "table" if self.arm.touches_table() else "blocked" if behind else ""
                if stopped:
                    self.stop()
                    return stopped
        self._at, self._place = path[-1], np.array(place)
        self.arm.command(self._at, np.zeros_like(self._at))
        return ""


def _line(start: Point, end: Point, count: int) -> NDArray[np.float64]:
    return start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
