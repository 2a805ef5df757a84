"""The only package that calls PyBullet: bodies, steps, contacts, images and arms of a simulated world."""

from cavin_pyro.envs.tabletop.physics.arm import Arm, ArmDescription, Kinematics
from cavin_pyro.envs.tabletop.physics.bullet import PYBULLET_DATA
from cavin_pyro.envs.tabletop.physics.world import TIME_STEP, PhysicsWorld, Poses, Uncopied

__all__ = ["PYBULLET_DATA", "TIME_STEP", "Arm", "ArmDescription", "Kinematics", "PhysicsWorld", "Poses", "Uncopied"]
