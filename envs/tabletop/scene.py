"""A table with objects, a robot that pushes them and a camera above: the world without a task.

Data flows one way: poses in the simulator, a depth image, segmented points, an `Observation`.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count, cycle
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cavin_pyro.envs.randomness import SENSOR, named_stream
from cavin_pyro.envs.tabletop.markings import Place, TileGroup, paint_of
from cavin_pyro.envs.tabletop.objects.object_sets import BUILTIN, ObjectSet
from cavin_pyro.envs.tabletop.objects.sampling import Area, ObjectParameters, ObjectRanges, sample_objects
from cavin_pyro.envs.tabletop.observation import MINIMUM_PIXELS, LatestClouds, Observation
from cavin_pyro.envs.tabletop.physics import PhysicsWorld, Poses, Uncopied
from cavin_pyro.envs.tabletop.robots import RobotFactory, robot_factory
from cavin_pyro.envs.tabletop.robots.robot import TIP_HEIGHT, Robot, Stopped, push, settle
from cavin_pyro.envs.tabletop.segmentation import Pixels, SegmenterFactory, segmenter_of
from cavin_pyro.envs.tabletop.sensors import DepthImage, DepthSensor, sensor_of
from cavin_pyro.envs.tabletop.sensors.camera import Camera
from cavin_pyro.envs.tabletop.workspace import OBJECT_SLOTS, push_endpoints
from cavin_pyro.envs.world import NoRoomError, finite_numbers
from cavin_pyro.models.checks import told

MOVED = 0.005  # metres; smaller moves do not count
TURNED = 0.1  # radians
FALLEN = -0.02  # metres; an object whose centre is lower has left the table
SCENE_SAMPLES = 50  # scenes sampled, at most, to find an acceptable one
FRAME_STEPS = 10  # physics steps between two frames of a video
TRAVEL_FRAME_STEPS = 40  # the same while the tool is in the air; an arm travels four fifths of the time

# The target is orange; obstacles are cool colours.
HUES = (0.58, 0.45, 0.72, 0.33)  # of the first obstacles; the others are brighter ones of nearly the same hues
COLORS = (
    (0.93, 0.42, 0.10),
    *(colorsys.hsv_to_rgb(hue, 0.55, 0.75) for hue in HUES),
    *(colorsys.hsv_to_rgb(hue, 0.30, 0.95) for hue in (*HUES, 0.88)),
)


@dataclass(frozen=True)
class PushReport:
    """The result of a push, from the simulator's ground truth.

    Attributes:
        unsafe: the tool would have touched down on an object, so the push was not executed. ineffective: no object
            moved.
        moved: [objects] metres. fallen: an object left the table.
        stopped: why the robot ended the push early, see `robots.robot.Stopped`; "" if it did not.
    """

    unsafe: bool
    ineffective: bool
    moved: NDArray[np.float64]
    fallen: bool
    stopped: Stopped = ""


class Scene(Uncopied):
    """A simulated world: sample scenes, push, and observe.

    Args:
        camera: the depth camera: a name in `CAMERAS`, the pose of one without errors, or any sensor.
        segmentation: a name in `cavin_pyro.envs.tabletop.segmentation.SEGMENTERS`, or a factory of segmenters.
        object_set: the set of the objects' names.
        robot: one of `ROBOTS`, or a factory of robots. assets: folder of the files that some robots need.
        slots: M, the objects that observations have room for.

    Raises ValueError: unknown camera, segmentation or robot, or its files are missing.
    """

    def __init__(
        self,
        *,
        camera: str | Camera | DepthSensor = "ideal",
        segmentation: str | SegmenterFactory = "mask",
        object_set: ObjectSet = BUILTIN,
        robot: str | RobotFactory = "stick",
        assets: str | Path | None = None,
        slots: int = OBJECT_SLOTS,
    ) -> None:
        self.sensor = sensor_of(camera)
        self.segmenter = segmenter_of(segmentation, self.true_masks, slots)
        self.slots = slots
        self.object_set = object_set
        self._make_robot = robot_factory(robot, assets)
        self.on_frame: Callable[[], None] | None = None  # called a few times during every push, to film it
        self.world = PhysicsWorld()
        self.markings: Sequence[TileGroup] = ()  # tiles that photographs show on the table
        self.places: Sequence[Place] = ()  # of the objects in their order, which photographs show as well
        self.objects: list[ObjectParameters] = []
        self.bodies: list[int] = []

    def close(self) -> None:
        """Free the simulator. Closing twice is harmless."""
        self.world.close()

    def sample(
        self,
        areas: Sequence[Area],
        ranges: ObjectRanges,
        generator: np.random.Generator,
        *,
        acceptable: Callable[[Observation], bool] = lambda observation: True,
    ) -> Observation:
        """Sample scenes until one settles with every object on the table, in view and acceptable.

        `areas`: start area of each object; the first is the target. `generator`: the scene's stream, from which those
        of objects and points derive (`cavin_pyro.envs.randomness`). Raises NoRoomError: no such scene was found.
        """
        seen = 0
        for _ in range(SCENE_SAMPLES):
            scene_generator, point_generator = generator.spawn(2)
            observation = self.reset(sample_objects(areas, ranges, scene_generator, self.object_set), point_generator)
            seen = int(observation.visible.sum())
            if seen == len(areas) and not self._any_fallen() and acceptable(observation):
                return observation
        found = f"none of {SCENE_SAMPLES} scenes on its start tiles is usable, the last with {seen} objects seen"
        raise NoRoomError(f"no room for {len(areas)} objects: {found}")

    def reset(self, objects: Sequence[ObjectParameters], point_generator: np.random.Generator) -> Observation:
        """Build a scene, let it settle, and observe it. Raises ValueError: no object, or more than `slots`."""
        if not 1 <= len(objects) <= self.slots:
            raise ValueError(f"a scene holds 1 to {self.slots} objects, not {len(objects)}")
        self.world.reset()
        self.objects = list(objects)
        self.bodies = [
            self.world.add_object(self.object_set.asset(one.name), one, color)
            for one, color in zip(objects, cycle(COLORS), strict=False)
        ]
        self.robot = self._make_robot(self.world)
        if missing := [name for name in vars(Robot) if name[0] != "_" and not hasattr(self.robot, name)]:
            raise ValueError(f"robot {type(self.robot).__name__} lacks {', '.join(missing)}")
        settle(self.world, self.robot, self.bodies, limit=720)
        self.sensor.reset(named_stream(point_generator, SENSOR))
        self._latest_clouds = LatestClouds(point_generator, self.slots)
        return self._observe(self._find_objects)

    def push(self, action: NDArray[np.floating]) -> PushReport:
        """Execute one normalised push [4] and wait until the objects rest.

        Raises ValueError: the action is not four finite numbers.
        """
        start, end = push_endpoints(finite_numbers("action", action, 4))
        before = self.ground_truth()
        steps = count()
        self.world.on_step = None if self.on_frame is None else lambda: self._film(next(steps))
        try:
            ended = push(self.robot, start, end)
        finally:
            self.world.on_step = None
        if ended not in ("unsafe", "unreachable"):
            settle(self.world, self.robot, self.bodies)
        after = self.ground_truth()
        moved = np.linalg.norm(after.positions - before.positions, axis=-1)
        turn = Rotation.from_quat(after.orientations) * Rotation.from_quat(before.orientations).inv()
        return PushReport(
            unsafe=ended == "unsafe",
            ineffective=bool((moved < MOVED).all() and (turn.magnitude() < TURNED).all()),
            moved=moved,
            fallen=self._any_fallen(),
            stopped="" if ended == "unsafe" else ended,
        )

    def _film(self, step: int) -> None:
        """Make a frame of the first physics step of a push, and of every `FRAME_STEPS`th."""
        if step % FRAME_STEPS == 0 and self.on_frame is not None:
            low = self.robot.tip()[2] < 2 * TIP_HEIGHT
            if low or step % TRAVEL_FRAME_STEPS == 0:
                self.on_frame()

    def observe(self) -> Observation:
        """Take a depth image and turn it into one cloud per object.

        Raises RuntimeError: the robot stands in the camera's view.
        """
        return self._observe(lambda image: self._pixels(image, self.segmenter.follow(image)))

    def _pixels(self, image: DepthImage, found: list[Pixels]) -> list[Pixels]:
        """What a segmentation found; raises ValueError for pixels that the image has not."""
        for indices in found:
            for index, size in zip(map(np.asarray, indices), image.depth.shape, strict=True):
                if index.size and (index.dtype.kind not in "iu" or not ((index >= 0) & (index < size)).all()):
                    wanted = f"rows and columns within {[*image.depth.shape]} for each object"
                    raise ValueError(f"{type(self.segmenter).__name__} must give {wanted}, not {told(indices)}")
        return found

    def _observe(self, segment: Callable[[DepthImage], list[Pixels]]) -> Observation:
        if not self.robot.clear_of_view(self.sensor.nominal):
            raise RuntimeError("the robot stands in the camera's view: nothing can be seen behind it")
        self.image = image = self.capture()
        return self._latest_clouds.update(image, segment(image))

    def _find_objects(self, image: DepthImage) -> list[Pixels]:
        """Begin an episode of the segmentation, and order the bodies as it orders the objects, for reports."""
        found = self._pixels(image, self.segmenter.start(image, self.point_at_target(image)))
        named: list[int] = []
        for pixels in found[: len(self.bodies)]:
            body = int(np.bincount(self._body_image[pixels] + 1, minlength=1).argmax()) - 1
            named.append(body if body in self.bodies and body not in named else -1)
        left = iter([body for body in self.bodies if body not in named])
        named += [-1] * (len(self.bodies) - len(named))
        ordered = [next(left) if body < 0 else body for body in named]
        self.objects = [self.objects[self.bodies.index(body)] for body in ordered]
        self.bodies = ordered
        return found

    def capture(self) -> DepthImage:
        """Take a depth image without updating the observation's clouds; `true_masks` then refers to this image."""
        taken = self.sensor.capture(self.world.render)
        if not isinstance(taken, tuple) or [isinstance(one, DepthImage) for one in taken] != [True, False]:
            wanted = "capture must return a DepthImage and body numbers"
            raise ValueError(f"{type(self.sensor).__name__}.{wanted}, not {told(taken)}")
        image, self._body_image = taken
        depth, bodies = np.asarray(image.depth), np.asarray(self._body_image)
        if depth.dtype.kind != "f" or bodies.dtype.kind != "i" or depth.ndim != 2 or depth.shape != bodies.shape:
            given = f"{depth.dtype} {[*depth.shape]} and {bodies.dtype} {[*bodies.shape]}"
            raise ValueError(f"{type(self.sensor).__name__}: depth and bodies must be floats and integers, not {given}")
        if not (depth >= 0).all() or depth.max() == np.inf:
            raise ValueError(f"{type(self.sensor).__name__}: depth must be metres, and 0 where nothing is measured")
        return image

    def true_masks(self) -> list[NDArray[np.bool_]]:
        """Ground truth of the latest image: the pixels [height, width] of each body. A real robot lacks it."""
        return [self._body_image == body for body in self.bodies]

    def point_at_target(self, image: DepthImage) -> tuple[int, int] | None:
        """A pixel (row, column) on the target, as a person points it out before an episode; None if it is occluded."""
        rows, columns = np.nonzero(self.true_masks()[0] & (image.depth > 0.0))
        if len(rows) < MINIMUM_PIXELS:
            return None
        # The object's pixel nearest to their middle, which need not lie on the object.
        nearest = int(((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2).argmin())
        return int(rows[nearest]), int(columns[nearest])

    def photograph(self, camera: Camera) -> NDArray[np.uint8]:
        """A colour image [height, width, 3] of the scene with the `markings` and `places` on the table, for people."""
        rendering = self.world.render(camera)
        if not self.markings and not self.places:
            return rendering.color
        places = tuple((float(x), float(y)) for x, y in self.places)
        return paint_of(camera, tuple(self.markings), places, COLORS)(rendering, self.bodies)

    def ground_truth(self) -> Poses:
        """True poses of the objects; for physics and tests, never for a planner."""
        return self.world.poses(self.bodies)

    def _any_fallen(self) -> bool:
        return bool((self.ground_truth().positions[:, 2] < FALLEN).any())
