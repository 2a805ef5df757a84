"""Bodies, steps, contacts and images of one simulated world.

Bodies are integers. Objects fall, slide and collide. The tool follows a prescribed path: its pose *and*
velocity are set before every step, so that contacts are solved as with an arm that no contact slows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.objects.object_sets import ObjectAsset
from cavin_pyro.envs.tabletop.objects.sampling import ObjectParameters
from cavin_pyro.envs.tabletop.physics.bullet import BulletClient, connect, pybullet
from cavin_pyro.envs.tabletop.sensors.camera import FAR, NEAR, Camera
from cavin_pyro.envs.tabletop.sensors.sensor import Rendering
from cavin_pyro.envs.tabletop.workspace import TABLE_CENTER, TABLE_HIGH, TABLE_LOW, TABLE_THICKNESS

TIME_STEP = 1.0 / 240.0  # seconds
SOLVER_ITERATIONS = 20  # per step; 50 leave all objects within 12 mm of it, and take 1.3 to 1.5 times as long
GRAVITY = 9.81  # metres per second squared
TABLE_FRICTION = 1.0  # Bullet multiplies both bodies' coefficients, so the object's own value is what counts
TABLE_COLOR = (0.80, 0.77, 0.72)
TOOL_FRICTION = 0.3
TOOL_MASS = 100.0  # kilograms; so heavy that no contact changes its velocity within a step
ROLLING_FRICTION = 0.003  # metres; stops cans and cups that lie on their side, as a cloth does
SPINNING_FRICTION = 0.003  # metres
ANGULAR_DAMPING = 0.5  # fraction of the angular velocity lost per second


@dataclass(frozen=True)
class Poses:
    """True poses of bodies.

    `positions`: [M, 3] metres. `orientations`: [M, 4] unit quaternions (x, y, z, w).
    """

    positions: NDArray[np.float64]
    orientations: NDArray[np.float64]


class Uncopied:
    """What holds a simulation."""

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse copies and pickling: a copy would push the objects of the same simulation, and close it."""
        raise TypeError("a simulation cannot be copied: make a second environment and reset it with the same seed")


class PhysicsWorld(Uncopied):
    """One PyBullet world in DIRECT mode with a table in it.

    Every `reset` starts from an empty simulation: Bullet's contact caches would otherwise keep the history of earlier
    scenes, and equal seeds would not give equal states.
    """

    def __init__(self) -> None:
        self.client = bullet = connect()  # for the files of this package alone
        # Called a hundred times per push: the client looks each of its functions up whenever it is named.
        self._advance, self._reset_pose = bullet.stepSimulation, bullet.resetBasePositionAndOrientation
        self._reset_velocity = bullet.resetBaseVelocity
        self.on_step: Callable[[], None] | None = None  # called after every step, to film or to measure
        self.reset()

    def close(self) -> None:
        """Disconnect; the world cannot be used afterwards. Closing twice is harmless."""
        if self.client.isConnected():
            self.client.disconnect()

    def reset(self) -> None:
        """Empty the world and put the table into it."""
        bullet = self.client
        if not bullet.isConnected():
            raise RuntimeError("this environment is closed: make another")
        bullet.resetSimulation()
        self.objects: list[int] = []  # bodies that `add_object` made
        self._cylinders: dict[tuple[float, float], int] = {}  # shapes for the test in `occupied`
        bullet.setGravity(0.0, 0.0, -GRAVITY)
        bullet.setTimeStep(TIME_STEP)
        bullet.setPhysicsEngineParameter(numSolverIterations=SOLVER_ITERATIONS, deterministicOverlappingPairs=1)
        self.table = _add_table(bullet)

    def add_object(self, asset: ObjectAsset, sampled: ObjectParameters, color: Sequence[float]) -> int:
        """Add a free body; every group of its mesh file becomes one convex part of its collision shape.

        `color`: red, green, blue in [0, 1].
        """
        bullet, size = self.client, [sampled.scale] * 3
        shape = {"shapeType": pybullet.GEOM_MESH, "meshScale": size}
        body = bullet.createMultiBody(
            baseMass=sampled.mass,
            baseCollisionShapeIndex=bullet.createCollisionShape(fileName=str(asset.collision), **shape),
            baseVisualShapeIndex=bullet.createVisualShape(fileName=str(asset.visual), rgbaColor=(*color, 1.0), **shape),
            basePosition=sampled.position,
            baseOrientation=sampled.orientation,
        )
        bullet.changeDynamics(
            body,
            -1,
            lateralFriction=sampled.friction,
            rollingFriction=ROLLING_FRICTION,
            spinningFriction=SPINNING_FRICTION,
            angularDamping=ANGULAR_DAMPING,
            restitution=0.0,
        )
        inertia = asset.inertia_of(sampled.mass, sampled.scale)
        if inertia is not None:
            bullet.changeDynamics(body, -1, localInertiaDiagonal=inertia)
        self.objects.append(int(body))
        return int(body)

    def add_tool(self, *, radius: float, length: float, position: Sequence[float]) -> int:
        """Add an upright cylinder (metres) that moves only where `place` puts it."""
        bullet = self.client
        body = bullet.createMultiBody(
            baseMass=TOOL_MASS,
            baseCollisionShapeIndex=bullet.createCollisionShape(pybullet.GEOM_CYLINDER, radius=radius, height=length),
            baseVisualShapeIndex=bullet.createVisualShape(
                pybullet.GEOM_CYLINDER, radius=radius, length=length, rgbaColor=(0.2, 0.2, 0.22, 1.0)
            ),
            basePosition=position,
        )
        bullet.changeDynamics(body, -1, lateralFriction=TOOL_FRICTION, restitution=0.0)
        return int(body)

    def place(self, body: int, position: Sequence[float], velocity: Sequence[float]) -> None:
        """Set an upright body's position (metres) and velocity (metres per second)."""
        self._reset_pose(body, position, (0.0, 0.0, 0.0, 1.0))
        self._reset_velocity(body, velocity, (0.0, 0.0, 0.0))

    def step(self) -> None:
        """Advance by one `TIME_STEP`."""
        self._advance()
        if self.on_step is not None:
            self.on_step()

    def overlaps(self, body: int, other: int) -> bool:
        """Whether two bodies currently interpenetrate."""
        return len(self.client.getClosestPoints(body, other, 0.0)) > 0

    def occupied(self, foot: Sequence[float] | NDArray[np.float64], *, radius: float, length: float) -> bool:
        """Whether an upright cylinder (metres), its lower end's centre at `foot`, would overlap an object."""
        size = radius, length
        if size not in self._cylinders:
            self._cylinders[size] = self.client.createCollisionShape(
                pybullet.GEOM_CYLINDER, radius=radius, height=length
            )
        middle = [foot[0], foot[1], foot[2] + length / 2]
        shape = {"collisionShapeA": self._cylinders[size], "collisionShapePositionA": middle}
        return any(self.client.getClosestPoints(-1, body, 0.0, **shape) for body in self.objects)

    def rest(self, bodies: Sequence[int]) -> None:
        """Put bodies to sleep: they cost no time and do not drift until something touches them."""
        for body in bodies:
            for state in (pybullet.ACTIVATION_STATE_ENABLE_SLEEPING, pybullet.ACTIVATION_STATE_SLEEP):
                self.client.changeDynamics(body, -1, activationState=state)

    def poses(self, bodies: Sequence[int]) -> Poses:
        """True poses of the bodies; for physics and tests, never for a planner."""
        found = [self.client.getBasePositionAndOrientation(body) for body in bodies]
        return Poses(np.array([pose[0] for pose in found]), np.array([pose[1] for pose in found]))

    def restore(self, bodies: Sequence[int], poses: Poses) -> None:
        """Put bodies at rest at poses, for example where they were before; to try several pushes from one state."""
        for body, position, orientation in zip(bodies, poses.positions, poses.orientations, strict=True):
            self.client.resetBasePositionAndOrientation(body, position, orientation)
            self.client.resetBaseVelocity(body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self.rest(bodies)

    def fastest(self, bodies: Sequence[int]) -> float:
        """Largest speed among the bodies, in metres per second; a turn of 1 rad/s counts as 0.05 m/s."""
        speeds = [0.0]
        for body in bodies:
            linear, angular = self.client.getBaseVelocity(body)
            speeds += [float(np.linalg.norm(linear)), 0.05 * float(np.linalg.norm(angular))]
        return max(speeds)

    def render(self, camera: Camera, *, table: bool = True) -> Rendering:
        """Depth, body numbers and colour as the camera sees them.

        `table`: whether to show it. It fills most of an image and would take four fifths of the time: it is rendered
        once per camera, and what is nearer than it is put before it.
        """
        # The renderer omits fully transparent bodies.
        self.client.changeVisualShape(self.table, -1, rgbaColor=(*TABLE_COLOR, 0.0))
        rendering = _render(self.client, camera)
        self.client.changeVisualShape(self.table, -1, rgbaColor=(*TABLE_COLOR, 1.0))
        if not table:
            return rendering
        behind = _table_alone(camera)
        nearer = rendering.depth < behind.depth
        whole = Rendering(behind.depth.copy(), behind.bodies.copy(), behind.color.copy())
        for name in ("depth", "bodies", "color"):
            getattr(whole, name)[nearer] = getattr(rendering, name)[nearer]
        return whole


def _add_table(bullet: BulletClient) -> int:
    sides = [high - low for low, high in zip(TABLE_LOW, TABLE_HIGH, strict=True)]
    half = [side / 2 for side in (*sides, TABLE_THICKNESS)]
    shape = {"shapeType": pybullet.GEOM_BOX, "halfExtents": half}
    table = bullet.createMultiBody(
        baseMass=0.0,
        baseCollisionShapeIndex=bullet.createCollisionShape(**shape),
        baseVisualShapeIndex=bullet.createVisualShape(rgbaColor=(*TABLE_COLOR, 1.0), **shape),
        basePosition=(*TABLE_CENTER, -TABLE_THICKNESS / 2),
    )
    bullet.changeDynamics(table, -1, lateralFriction=TABLE_FRICTION)
    return int(table)


@lru_cache(maxsize=8)
def _table_alone(camera: Camera) -> Rendering:
    """In it the table has its usual number, that of the first body."""
    bullet = connect()
    try:
        _add_table(bullet)
        return _render(bullet, camera)
    finally:
        bullet.disconnect()


def _render(bullet: BulletClient, camera: Camera) -> Rendering:
    position, axes = np.array(camera.position), camera.axes
    # An intrinsic matrix written as the frustum that OpenGL's conventions want, column by column.
    along_row, along_column, column, row = camera.intrinsics
    width, height = camera.width, camera.height
    frustum = np.zeros((4, 4))
    frustum[0, 0], frustum[1, 1] = 2 * along_row / width, 2 * along_column / height
    frustum[0, 2], frustum[1, 2] = 1 - 2 * column / width, 2 * row / height - 1
    frustum[2, 2], frustum[2, 3] = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    frustum[3, 2] = -1.0
    image = bullet.getCameraImage(
        width,
        height,
        viewMatrix=pybullet.computeViewMatrix(position, position + position[2] * axes[2], -axes[1]),
        projectionMatrix=frustum.T.ravel().tolist(),
        renderer=pybullet.ER_TINY_RENDERER,
        shadow=0,
        lightDirection=(0.4, 0.3, 1.0),
    )
    buffer = np.asarray(image[3], dtype=np.float64).reshape(height, width)
    depth = FAR * NEAR / (FAR - (FAR - NEAR) * buffer)
    bodies = np.asarray(image[4], dtype=np.int64).reshape(height, width)
    color = np.asarray(image[2], dtype=np.uint8).reshape(height, width, 4)[..., :3]
    return Rendering(depth, bodies, color)
