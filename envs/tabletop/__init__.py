"""The paper's world: a robot arm pushes objects on a cluttered table (PyBullet, depth images)."""
