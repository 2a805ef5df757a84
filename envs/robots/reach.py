"""Inverse kinematics: joint angles that put the tip of an upright stick at a position.

The stick is round, so its rotation about its own axis is free: there are five conditions, and an arm of seven joints
has two redundant degrees of freedom, which keep it near a posture. The first joint turns the whole arm about the
vertical, so a table over distance and height gives an initial guess for every position, which damped least squares
refines. The solution depends on the position only, not on the arm's state: equal pushes are executed equally.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from envs.physics import ArmDescription, Kinematics
from envs.robots.robot import ABOVE_HEIGHT, TIP_HEIGHT, Point

DISTANCES = np.arange(0.20, 1.001, 0.05)  # metres from the first joint's axis
HEIGHTS = np.linspace(TIP_HEIGHT, ABOVE_HEIGHT, 4)  # metres
CLOSE = 1e-4  # tolerance: metres from the position, and radians from upright
ITERATIONS = 60
DAMPING = 1e-5
TO_POSTURE = 0.1  # fraction of the way back to the posture per iteration, in the null space of the tip
LARGEST_STEP = 0.3  # radians per iteration


class InverseKinematics:
    """Joint angles for positions of the tip.

    Raises:
        ValueError: the arm's file cannot be used.
    """

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
