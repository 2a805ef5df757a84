"""A table with objects, a robot that pushes them and a camera that looks: the world without any task.

Data flows one way: poses in the simulator, a depth image, segmented points, an `Observation`.
"""

from __future__ import annotations

import atexit
import colorsys
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from envs.camera import Camera, sample_cloud
from envs.objects import Area, ObjectParameters, ObjectRanges, draw_objects
from envs.physics import PhysicsWorld, Poses
from envs.robots import FrameHook, StickRobot
from envs.segmentation import Pixels, segmenter_of
from envs.sensors import DepthImage, DepthSensor, sensor_of
from envs.shapes import builtin_shape, write_mesh
from envs.workspace import MAXIMUM_OBJECTS, POINTS_PER_OBJECT, push_endpoints

MINIMUM_PIXELS = 8  # fewer pixels than this do not show where an object is
MOVED = 0.005  # metres; less motion than this counts as none
TURNED = 0.1  # radians
FALLEN = -0.02  # metres; an object whose centre is lower has left the table
DRAWS = 50  # scenes drawn before giving up on an acceptable one

# The target is orange; obstacles are cool colours.
COLORS = ((0.93, 0.42, 0.10), *(colorsys.hsv_to_rgb(hue, 0.55, 0.75) for hue in (0.58, 0.45, 0.72, 0.33)))


@dataclass(frozen=True)
class Observation:
    """What the camera tells of the table, padded to `MAXIMUM_OBJECTS` (M) objects.

    Attributes:
        clouds: [M, 256, 3] metres in the robot's base frame. centers: [M, 3] metres, the mean of each cloud.
        mask: [M] bool, True for objects seen at least once.
        visible: [M] bool, True for objects in this image; an object hidden in it keeps the cloud last seen.
    """

    clouds: NDArray[np.float32]
    centers: NDArray[np.float32]
    mask: NDArray[np.bool_]
    visible: NDArray[np.bool_]


@dataclass(frozen=True)
class PushReport:
    """What a push did, from the simulator's own knowledge.

    Attributes:
        unsafe: the tool would have come down on an object, so nothing was done. ineffective: no object moved.
        moved: [objects] metres. fallen: an object left the table.
    """

    unsafe: bool
    ineffective: bool
    moved: NDArray[np.float64]
    fallen: bool


@cache
def _mesh_folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="cavin_pyro_meshes_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


class Scene:
    """One world in which scenes are drawn, pushed and looked at.

    Args:
        camera: the depth camera: a name in `envs.sensors.CAMERAS`, the pose of one without errors, or any sensor.
        segmentation: a name in `envs.segmentation.SEGMENTERS`.
        on_frame: called a few times during every push, for whoever films it.

    Raises:
        ValueError: unknown camera or segmentation.
    """

    def __init__(
        self,
        *,
        camera: str | Camera | DepthSensor = "ideal",
        segmentation: str = "mask",
        on_frame: FrameHook | None = None,
    ) -> None:
        self.sensor = sensor_of(camera)
        self.segmenter = segmenter_of(segmentation, self.truth)
        self.on_frame = on_frame
        self.world = PhysicsWorld()
        self.objects: list[ObjectParameters] = []
        self.bodies: list[int] = []
        self.seconds = {
            "physics": 0.0,
            "rendering": 0.0,
            "segmentation": 0.0,
            "points": 0.0,
        }  # where the time went, summed

    @property
    def camera(self) -> Camera:
        """Where the camera was meant to be mounted; pictures for people are taken from there."""
        return self.sensor.nominal

    def close(self) -> None:
        """Free the simulator. Closing twice is harmless."""
        self.world.close()

    def draw(
        self,
        areas: Sequence[Area],
        ranges: ObjectRanges,
        generator: np.random.Generator,
        *,
        acceptable: Callable[[Observation], bool] = lambda observation: True,
    ) -> Observation:
        """Draw scenes until one settles with every object on the table, in view and acceptable.

        Args:
            areas: where each object may start; the first is the target.
            generator: the scene's randomness; the points' randomness is spawned from it.

        Raises:
            ValueError: the areas hold no such scene.
        """
        for _ in range(DRAWS):
            scene_generator, point_generator = generator.spawn(2)
            observation = self.reset(draw_objects(areas, ranges, scene_generator), point_generator)
            if observation.visible.sum() == len(areas) and not self._any_fallen() and acceptable(observation):
                return observation
        raise ValueError(
            f"no room for {len(areas)} objects: none of {DRAWS} scenes drawn on the layout's start tiles could be used"
        )

    def reset(self, objects: Sequence[ObjectParameters], point_generator: np.random.Generator) -> Observation:
        """Build a scene, let it settle, and look at it.

        Raises:
            ValueError: no object, or more than `MAXIMUM_OBJECTS`.
        """
        if not 1 <= len(objects) <= MAXIMUM_OBJECTS:
            raise ValueError(f"a scene holds 1 to {MAXIMUM_OBJECTS} objects, not {len(objects)}")
        began = time.perf_counter()
        self.world.reset()
        self.objects = list(objects)
        self.bodies = [
            self.world.add_object(
                write_mesh(builtin_shape(one.name), _mesh_folder()),
                scale=one.scale,
                mass=one.mass,
                friction=one.friction,
                position=one.position,
                orientation=one.orientation,
                color=color,
            )
            for one, color in zip(objects, COLORS, strict=False)
        ]
        self.robot = StickRobot(self.world)
        self.robot.settle(self.bodies, limit=720)
        self._points = point_generator
        (sensor_generator,) = point_generator.spawn(1)
        self.sensor.reset(sensor_generator)
        self._clouds = np.zeros((MAXIMUM_OBJECTS, POINTS_PER_OBJECT, 3), dtype=np.float32)
        self._mask = np.zeros(MAXIMUM_OBJECTS, dtype=np.bool_)
        self.seconds["physics"] += time.perf_counter() - began
        return self._observe(first=True)

    def push(self, action: NDArray[np.floating]) -> PushReport:
        """Carry out one normalised push [4] and wait until the objects rest.

        Raises:
            ValueError: the action is not four finite numbers.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (4,) or not np.isfinite(action).all():
            raise ValueError(f"an action is four finite numbers (x, y, dx, dy), not {action.tolist()}")
        began = time.perf_counter()
        before = self.ground_truth()
        start, end = push_endpoints(action)
        safe = self.robot.push(start, end, self.bodies, on_frame=self.on_frame)
        if safe:
            self.robot.settle(self.bodies)
        after = self.ground_truth()
        moved = np.linalg.norm(after.positions - before.positions, axis=-1)
        turn = Rotation.from_quat(after.orientations) * Rotation.from_quat(before.orientations).inv()
        self.seconds["physics"] += time.perf_counter() - began
        return PushReport(
            unsafe=not safe,
            ineffective=bool((moved < MOVED).all() and (turn.magnitude() < TURNED).all()),
            moved=moved,
            fallen=self._any_fallen(),
        )

    def observe(self) -> Observation:
        """Take a depth image and turn it into one cloud per object."""
        return self._observe(first=False)

    def _observe(self, *, first: bool) -> Observation:
        began = time.perf_counter()
        image, self._seen = self.sensor.look(self.world.render)
        rendered = time.perf_counter()
        if first:
            found = self.segmenter.start(image, self._point_at_target(image))
            self._put_in_order(found)
        else:
            found = self.segmenter.follow(image)
        segmented = time.perf_counter()
        visible = np.zeros(MAXIMUM_OBJECTS, dtype=np.bool_)
        for slot, (rows, columns) in enumerate(found):
            if len(rows) >= MINIMUM_PIXELS:
                points = image.camera.points(image.depth, rows, columns)
                self._clouds[slot] = sample_cloud(points, POINTS_PER_OBJECT, self._points)
                visible[slot] = True
        self._mask |= visible
        centers = self._clouds.mean(axis=1, dtype=np.float64).astype(np.float32)
        self.seconds["rendering"] += rendered - began
        self.seconds["segmentation"] += segmented - rendered
        self.seconds["points"] += time.perf_counter() - segmented
        return Observation(self._clouds.copy(), centers, self._mask.copy(), visible)

    def truth(self) -> list[NDArray[np.bool_]]:
        """The simulator's word on the latest image: the pixels [height, width] of each body. No robot has it."""
        return [self._seen == body for body in self.bodies]

    def _point_at_target(self, image: DepthImage) -> tuple[int, int] | None:
        """What a person does once, before an episode: point at the target in the image."""
        rows, columns = np.nonzero(self.truth()[0] & (image.depth > 0.0))
        if len(rows) < MINIMUM_PIXELS:
            return None
        # Of its pixels the one nearest to their middle, which need not lie on the object itself.
        nearest = int(((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2).argmin())
        return int(rows[nearest]), int(columns[nearest])

    def _put_in_order(self, found: list[Pixels]) -> None:
        """Number the bodies as the segmentation numbers what it found: bookkeeping for reports, which tell of both."""
        named: list[int] = []
        for pixels in found[: len(self.bodies)]:
            counts = np.bincount(self._seen[pixels] + 1, minlength=1)
            body = int(counts.argmax()) - 1
            named.append(body if body in self.bodies and body not in named else -1)
        left = iter([body for body in self.bodies if body not in named])
        named += [-1] * (len(self.bodies) - len(named))
        ordered = [next(left) if body < 0 else body for body in named]
        self.objects = [self.objects[self.bodies.index(body)] for body in ordered]
        self.bodies = ordered

    def photograph(self, camera: Camera) -> NDArray[np.uint8]:
        """A colour image [height, width, 3] of the scene, for people."""
        return self.world.render(camera).color

    def ground_truth(self) -> Poses:
        """True poses of the objects; for physics and tests, never for a planner."""
        return self.world.poses(self.bodies)

    def _any_fallen(self) -> bool:
        return bool((self.ground_truth().positions[:, 2] < FALLEN).any())
