"""An arm in a simulated world: joints driven by motors, a stick in its hand.

Only the stick touches objects. The other links collide with the table alone, so that a wrist cannot move a tall box:
the result of a push must not depend on the size of the hand (`stick` has none).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.physics.bullet import BulletClient, connect, pybullet
from cavin_pyro.envs.tabletop.physics.world import TOOL_FRICTION, PhysicsWorld

STICK, TIP = "stick", "stick_tip"  # links of the URDF: the stick, and its lower end
MOTOR_FORCE = 1e4  # newton metres; with the effort limits of real arms heavy objects bend the line of a push
EVERYTHING, STATIC_ONLY = -1, 2  # Bullet's collision masks
TOUCHING = 1e-4  # metres between arm and table that count as contact
INVISIBLE = (1.0, 1.0, 1.0, 0.0)  # the renderer omits fully transparent shapes


@dataclass(frozen=True)
class ArmDescription:
    """An arm and its place.

    Attributes:
        urdf: its file, with a link `stick` that ends in `stick_tip`; the tip's z axis points out of the stick.
        base: (x, y, z) metres of the URDF's origin.
        home: radians by joint, from base to tool; out of the camera's view. The first turns about the vertical.
        posture: radians, in the order of `home`; the preferred one among all solutions of the inverse kinematics.
        held: fixed positions of the other movable joints, radians or metres.
        stand: links that the arm stands on, which are not rendered.
    """

    urdf: Path
    base: tuple[float, float, float]
    home: tuple[tuple[str, float], ...]
    posture: tuple[float, ...]
    held: tuple[tuple[str, float], ...] = ()
    stand: tuple[str, ...] = ()


class LoadedArm:
    """An arm's body in a simulation, and PyBullet's numbers of its parts.

    Raises ValueError: PyBullet cannot read the file, or it lacks a joint or link of the description.
    """

    def __init__(self, client: BulletClient, description: ArmDescription) -> None:
        self.client, self.description = client, description
        try:
            self.body = int(client.loadURDF(str(description.urdf), basePosition=description.base, useFixedBase=True))
        except pybullet.error as error:
            raise ValueError(f"{description.urdf} is not a URDF that PyBullet can read") from error
        infos = [client.getJointInfo(self.body, number) for number in range(client.getNumJoints(self.body))]
        joints = {info[1].decode(): info[0] for info in infos}
        base = client.getBodyInfo(self.body)[0].decode()
        self.links = {base: -1, **{info[12].decode(): info[0] for info in infos}}
        named = {name for name, _ in (*description.home, *description.held)}
        missing = sorted((named - set(joints)) | ({STICK, TIP, *description.stand} - set(self.links)))
        if missing:
            raise ValueError(f"{description.urdf} has no joint or link named {missing[0]!r}")
        self.movable = [info[0] for info in infos if info[2] != pybullet.JOINT_FIXED]
        self.joints = [joints[name] for name, _ in description.home]
        self.home = np.array([angle for _, angle in description.home])
        self.held = {joints[name]: value for name, value in description.held}
        limits = [infos[joint] for joint in self.joints]
        self.low, self.high = np.array([one[8] for one in limits]), np.array([one[9] for one in limits])
        self.fastest = np.array([one[11] for one in limits])  # radians per second
        for joint, value in self.held.items():
            client.resetJointState(self.body, joint, value)
        self.put(self.home)

    def put(self, angles: NDArray[np.float64]) -> None:
        """Set the joints [J] (radians) at once, ignoring collisions."""
        for joint, angle in zip(self.joints, angles, strict=True):
            self.client.resetJointState(self.body, joint, angle)


class Arm(LoadedArm):
    """An arm in a `PhysicsWorld`, standing still in its home pose."""

    def __init__(self, world: PhysicsWorld, description: ArmDescription) -> None:
        super().__init__(world.client, description)
        self._table = world.table
        for name in [*description.stand, *_without_picture(description.urdf)]:
            self.client.changeVisualShape(self.body, self.links[name], rgbaColor=INVISIBLE)
        for link in self.links.values():
            mask = EVERYTHING if link == self.links[STICK] else STATIC_ONLY
            self.client.setCollisionFilterGroupMask(self.body, link, 1, mask)
        self.client.changeDynamics(self.body, self.links[STICK], lateralFriction=TOOL_FRICTION, restitution=0.0)
        self._drive(list(self.held), list(self.held.values()), [0.0] * len(self.held))
        self.command(self.angles(), np.zeros(len(self.joints)))

    def command(self, angles: NDArray[np.float64], speeds: NDArray[np.float64]) -> None:
        """From now on, correct the joints to `angles` [J] radians while they turn at `speeds` [J] radians per second.

        Both gains are 1: an error vanishes after one step, like with a stiff controller.
        """
        self._drive(self.joints, angles.tolist(), speeds.tolist())

    def angles(self) -> NDArray[np.float64]:
        """Current joint angles: [J] radians."""
        return np.array([one[0] for one in self.client.getJointStates(self.body, self.joints)])

    def tip(self) -> NDArray[np.float64]:
        """Current position of the stick's tip: [3] metres."""
        state = self.client.getLinkState(self.body, self.links[TIP], computeForwardKinematics=1)
        return np.array(state[4])

    def touches_table(self) -> bool:
        """Whether any part of the arm touches the table, after the step just made."""
        contacts = self.client.getContactPoints(self.body, self._table)
        return any(contact[8] <= TOUCHING for contact in contacts)

    def corners(self) -> NDArray[np.float64]:
        """Corners of axis-aligned boxes around the links, without the stand: [L, 8, 3] metres."""
        links = [link for name, link in self.links.items() if name not in self.description.stand]
        boxes = np.array([self.client.getAABB(self.body, link) for link in links])
        choice = np.array(list(product((0, 1), repeat=3)))
        return boxes[:, choice, np.arange(3)]

    def lift_out(self) -> None:
        """Set the joints to the home pose at once, ignoring collisions."""
        self.put(self.home)
        self.command(self.home, np.zeros_like(self.home))

    def _drive(self, joints: list[int], positions: list[float], speeds: list[float]) -> None:
        if joints:
            self.client.setJointMotorControlArray(
                self.body,
                joints,
                pybullet.POSITION_CONTROL,
                targetPositions=positions,
                targetVelocities=speeds,
                forces=[MOTOR_FORCE] * len(joints),
                positionGains=[1.0] * len(joints),
                velocityGains=[1.0] * len(joints),
            )


def _without_picture(urdf: Path) -> list[str]:
    """Links with a collision shape and no visual one: PyBullet would render the collision shape."""
    links = ElementTree.parse(urdf).getroot().iter("link")
    return [link.attrib["name"] for link in links if link.find("collision") is not None and link.find("visual") is None]


class Forward(NamedTuple):
    """The stick's tip for some joint angles.

    `position`: [3] metres. `axis`: [3] unit vector out of the stick, (0, 0, -1) where it is upright. `jacobian`: [6, J]
    change of position (metres) and of orientation (radians) per radian of each joint.
    """

    position: NDArray[np.float64]
    axis: NDArray[np.float64]
    jacobian: NDArray[np.float64]


class Kinematics(LoadedArm):
    """An arm alone in a separate simulation."""

    def __init__(self, description: ArmDescription) -> None:
        super().__init__(connect(), description)
        self._columns = [self.movable.index(joint) for joint in self.joints]
        self._at = np.zeros(len(self.movable))
        for joint, value in self.held.items():
            self._at[self.movable.index(joint)] = value

    def __call__(self, angles: NDArray[np.float64]) -> Forward:
        """Forward kinematics of joint angles [J] radians."""
        self.put(angles)
        self._at[self._columns] = angles
        link, body, client = self.links[TIP], self.body, self.client
        state = client.getLinkState(body, link, computeForwardKinematics=1)
        axis = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)[:, 2]
        still = [0.0] * len(self._at)
        # The tip's frame has its centre of mass in its origin, so the local position is zero.
        linear, angular = client.calculateJacobian(body, link, [0.0] * 3, self._at.tolist(), still, still)
        jacobian = np.concatenate([np.array(linear), np.array(angular)])[:, self._columns]
        return Forward(np.array(state[4]), axis, jacobian)
