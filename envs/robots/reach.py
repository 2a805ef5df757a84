"""Inverse kinematics: joint angles that put the tip of an upright stick at a place.

The stick is round, so how it is turned about its own axis does not matter: five conditions, and an arm of seven
joints has two to spare. They go into staying near a posture. The first joint turns the whole arm about the vertical,
hence a table over distance and height alone gives a first guess for every place, and damped least squares finishes it.
The answer depends on the place only, not on where the arm was: equal pushes are carried out equally.
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
CLOSE = 1e-4  # metres from the place, and radians from upright, that count as there
ITERATIONS = 60
DAMPING = 1e-5
TO_POSTURE = 0.1  # share of the way back to the posture, per iteration, as far as the tip does not notice
LARGEST_STEP = 0.3  # radians per iteration


class InverseKinematics:
    """Joint angles for places of the tip.

    Raises:
        ValueError: the arm's file cannot be used.
    """

    def __init__(self, description: ArmDescription) -> None:
        self.forward = Kinematics(description)
        self._base, self._posture = np.array(description.base), np.array(description.posture)
        self.solve = lru_cache(maxsize=4096)(self._solve)
        # From the middle outwards and inwards, each from its neighbour: the elbow never flips between them.
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
        """Joint angles [J] radians that put the tip at `place` [3] metres, upright; None where there are none."""
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
        """Damped least squares from a first guess, within the joints' limits: angles [J], and whether they serve."""
        for _ in range(ITERATIONS):
            position, axis, jacobian = self.forward(angles)
            # The turn that would make the axis point down: its part about the vertical is free.
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
