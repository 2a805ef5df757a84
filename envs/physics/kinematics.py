"""Forward kinematics of an arm: position and Jacobian of the tip for given joint angles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from envs.physics.arm import TIP, ArmDescription, LoadedArm
from envs.physics.bullet import connect, pybullet


class Forward(NamedTuple):
    """The stick's tip for some joint angles.

    Attributes:
        position: [3] metres. axis: [3] unit vector out of the stick, (0, 0, -1) where it is upright.
        jacobian: [6, J] change of position (metres) and of orientation (radians) per radian of each joint.
    """

    position: NDArray[np.float64]
    axis: NDArray[np.float64]
    jacobian: NDArray[np.float64]


class Kinematics:
    """An arm alone in a separate simulation.

    Raises:
        ValueError: as `envs.physics.arm.LoadedArm`.
    """

    def __init__(self, description: ArmDescription) -> None:
        self._client = connect()
        self._arm = LoadedArm(self._client, description)
        self._columns = [self._arm.movable.index(joint) for joint in self._arm.joints]
        self._at = np.zeros(len(self._arm.movable))
        for joint, value in self._arm.held.items():
            self._at[self._arm.movable.index(joint)] = value
        self.low, self.high, self.fastest = self._arm.low, self._arm.high, self._arm.fastest

    def __call__(self, angles: NDArray[np.float64]) -> Forward:
        """Forward kinematics of joint angles [J] radians."""
        self._arm.put(angles)
        self._at[self._columns] = angles
        link, body, client = self._arm.links[TIP], self._arm.body, self._client
        state = client.getLinkState(body, link, computeForwardKinematics=1)
        axis = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)[:, 2]
        still = [0.0] * len(self._at)
        # The tip's frame has its centre of mass in its origin, so the local position is zero.
        linear, angular = client.calculateJacobian(body, link, [0.0] * 3, self._at.tolist(), still, still)
        jacobian = np.concatenate([np.array(linear), np.array(angular)])[:, self._columns]
        return Forward(np.array(state[4]), axis, jacobian)
