"""The only package that calls PyBullet: bodies, steps, contacts, images and arms of a simulated world."""

from envs.physics.arm import Arm, ArmDescription
from envs.physics.bullet import PYBULLET_DATA
from envs.physics.kinematics import Kinematics
from envs.physics.visuals import Poses, Visual
from envs.physics.world import TIME_STEP, PhysicsWorld

__all__ = [
    "PYBULLET_DATA",
    "TIME_STEP",
    "Arm",
    "ArmDescription",
    "Kinematics",
    "PhysicsWorld",
    "Poses",
    "Visual",
]
