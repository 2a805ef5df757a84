"""The Gymnasium environment: a scene, a task's reward, and the end of an episode."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from cavin_pyro.envs.randomness import GOAL, LAYOUT, named_stream
from cavin_pyro.envs.tabletop.layouts import GENERATED, generate_task, possible_tasks
from cavin_pyro.envs.tabletop.objects.object_sets import ObjectSet, load_object_set, plain_name
from cavin_pyro.envs.tabletop.objects.sampling import Area, ObjectRanges
from cavin_pyro.envs.tabletop.observation import Observation, ObservedPoints
from cavin_pyro.envs.tabletop.physics import Uncopied
from cavin_pyro.envs.tabletop.robots import RobotFactory
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.envs.tabletop.segmentation import SegmenterFactory
from cavin_pyro.envs.tabletop.sensors import DepthSensor
from cavin_pyro.envs.tabletop.sensors.camera import Camera
from cavin_pyro.envs.tabletop.tasks import TASKS, GeneratedLayouts, Outcome, Task, TaskReward, TileSet
from cavin_pyro.envs.tabletop.tasks.task import check_functions
from cavin_pyro.envs.tabletop.workspace import (
    MAXIMUM_OBJECTS,
    POINTS_PER_OBJECT,
    SPACE,
    TILE_SIDE,
    object_slots,
    push_endpoints,
    tile_center,
)
from cavin_pyro.envs.world import Geometry, World, known_options
from cavin_pyro.models.checks import check_choice, check_number, typed
from cavin_pyro.models.state import State

EPISODE_STEPS = 60
TARGET_JITTER = 0.05  # metres; how far from its tile's centre the target may start, on each axis
OBSTACLE_JITTER = TILE_SIDE / 2  # metres; obstacles start anywhere on their tiles
SPECTATOR = Camera(  # opposite the robot, for pictures
    width=800,
    height=400,
    position=(1.5, 0.0, 1.25),
    rotation=(1.03989, 0.0, 2.96450),
    intrinsics_offset=(225.0, 225.0, 0.0, 14.0),
)
ObservationDict = dict[str, NDArray[Any]]


class PushingEnv(Uncopied, World):
    """Push objects on a table until a task's goal is reached, observed by a depth camera from above.

    Observation: `clouds` [M, 256, 3] metres, `centers` [M, 3] metres, `mask` [M] (known objects, object 0 is
    the target), `visible` [M] (objects in the current image). M is 5, or `objects` if there are more.
    Action: one push (x, y, dx, dy) in [-1, 1].

    `info` of a reset: `steps`, which is 0, and the episode's `task` in its layout and with its goal. `info` of a step:
    `steps` so far, `unsafe` and `ineffective` pushes, `stopped` (why the robot ended the push early: "unreachable", not
    begun; "blocked" by an obstacle; contact with the "table"; "" if it did not), `success`, `violation`, `fall`,
    `terms`, the named terms of the reward, and `strict`, the same step by `criterion="strict"`: `success`, `violation`,
    `fall` and `reward`. An episode terminates at success, violation or fall, and is truncated
    after `maximum_steps`.

    Args:
        task, layout, tiles: see `possible_tasks` in `envs.tabletop.layouts`; `tiles` replaces fields of the layout.
            `layout="random"` is sampled at every reset. A `Task` object has its own layout.
        generated: what is wanted of `layout="generated"`, which is generated at every reset.
        reward: dense or sparse. criterion: what ends an episode as a violation, see `TaskReward`. Scenes and
            observations do not depend on it. margin: metres, of the reward by which plans are made.
        objects: how many, 1 to 10. ranges: object parameters, or a mapping of them, which JSON can hold.
        robot: one of `cavin_pyro.envs.tabletop.robots.ROBOTS`, or a factory of robots.
        object_set: a key of `cavin_pyro.envs.tabletop.objects.object_sets.OBJECT_SETS`, or a set.
        camera, segmentation: see `cavin_pyro.envs.tabletop.scene.Scene`.
        assets: folder of meshes, for robots and sets that need one.
        maximum_steps: pushes per episode.

    Raises:
        ValueError: an argument is out of its range, a function of the user's task returns another type or shape than
            `Task` documents, the layout has no room for the objects, or the robot's files are missing.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    space = SPACE
    step_names = ("push", "pushes")
    features = 64  # of `geometry`, which makes them of the clouds
    sees_clouds = True

    @typed(ValueError)
    def __init__(
        self,
        *,
        task: str | type[Task] | Task = "crossing",
        layout: int | str | Path = 0,
        tiles: Mapping[str, Any] | None = None,
        generated: GeneratedLayouts | None = None,
        reward: str = "sparse",
        criterion: str = "strict",
        margin: float = 0.02,
        objects: int = 3,
        ranges: ObjectRanges | Mapping[str, Any] | None = None,
        object_set: str | ObjectSet = "builtin",
        assets: str | Path | None = None,
        maximum_steps: int = EPISODE_STEPS,
        camera: str | Camera | DepthSensor = "ideal",
        segmentation: str | SegmenterFactory = "mask",
        render_mode: str | None = None,
        robot: str | RobotFactory = "stick",
    ) -> None:
        check_number("objects", objects, 1, MAXIMUM_OBJECTS, whole=True)
        check_number("maximum_steps", maximum_steps, 1, whole=True)
        check_choice("render_mode", render_mode, (None, "rgb_array"))
        if isinstance(task, Task) and (layout != 0 or tiles):
            raise ValueError("a task object has its own layout: give its class, or neither layout nor tiles")
        self._generate: Callable[[np.random.Generator], Task] | None = None
        if isinstance(task, Task):
            self.tasks: tuple[Task, ...] = (task,)
        elif layout == GENERATED:
            wanted = generated or GeneratedLayouts()
            self.tasks = (generate_task(task, wanted, None, tiles),)
            self._generate = partial(generate_task, task, wanted, tiles=tiles)
        else:
            self.tasks = possible_tasks(task, layout, tiles)
        if type(self.tasks[0]) not in TASKS.values():
            check_functions(self.tasks[0], int(objects))
        self._rules, self.margin = (reward, criterion), margin
        self._goals: dict[tuple[int, str], TaskReward] = {}
        self._begin(self.tasks[0])
        self.goal()
        self.objects, self.maximum_steps, self.render_mode = int(objects), maximum_steps, render_mode
        available = load_object_set(object_set, assets)
        named = ranges or {"names": tuple(dict.fromkeys(map(plain_name, available.names)))}
        if isinstance(named, Mapping):
            named = ObjectRanges(**known_options(named, *vars(ObjectRanges()), of="ranges"))
        self.ranges = named
        slots = object_slots(self.objects)
        self.scene = Scene(
            camera=camera, segmentation=segmentation, object_set=available, robot=robot, assets=assets, slots=slots
        )
        shape = (slots, POINTS_PER_OBJECT, 3)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "clouds": gymnasium.spaces.Box(-10.0, 10.0, shape, np.float32),
                "centers": gymnasium.spaces.Box(-10.0, 10.0, (slots, 3), np.float32),
                "mask": gymnasium.spaces.MultiBinary(slots),
                "visible": gymnasium.spaces.MultiBinary(slots),
            }
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self._observation: Observation | None = None
        self._steps = 0

    @typed(ValueError)
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationDict, dict[str, Any]]:
        """Sample a layout, and a scene in which the episode has not already ended.

        Args:
            options: `layout`, the number of one of the environment's `tasks`, instead of a random one.

        Raises ValueError: the layout has no room for the objects, or there is no layout of that number.
        """
        super().reset(seed=seed)
        (scene_generator,) = self.np_random.spawn(1)
        sampled = int(named_stream(scene_generator, LAYOUT).integers(len(self.tasks)))
        number = known_options(options, "layout").get("layout", sampled)
        if number not in range(len(self.tasks)):
            raise ValueError(f"no layout {number} to reset to: choose from 0 to {len(self.tasks) - 1}")
        if self._generate is not None:
            self.tasks = (self._generate(named_stream(scene_generator, LAYOUT)),)
            self._goals.clear()
        self._begin(self.tasks[number])
        target = _areas(self.task.target_start, TARGET_JITTER)
        obstacle = _areas(self.task.obstacle_start, OBSTACLE_JITTER)
        areas = [target, *[obstacle] * (self.objects - 1)]
        can_start = partial(self._can_start, self.task, named_stream(scene_generator, GOAL))
        self._observation = self.scene.sample(areas, self.ranges, scene_generator, acceptable=can_start)
        self.scene.markings, self.scene.places = self.task.tile_groups(), self.task.object_places()
        self._steps = 0
        return _as_dict(self._observation), {"steps": 0, "task": self.task}

    def step(self, action: NDArray[np.float32]) -> tuple[ObservationDict, float, bool, bool, dict[str, Any]]:
        """Push, wait until the objects rest, observe them, and compute the reward.

        Raises ValueError: the action is not four finite numbers. RuntimeError: called before `reset`.
        """
        if self._observation is None:
            raise RuntimeError("call reset() before step()")
        self.scene.on_frame = self.on_frame
        report = self.scene.push(action)
        observation = self.scene.observe()
        outcome = _judged(self.reward, self._observation, observation, fallen=report.fallen)
        strict = _judged(self._strict_reward, self._observation, observation, fallen=report.fallen)
        terms = {name: float(term) for name, term in outcome.terms.items()}
        self._observation = observation
        self._steps += 1
        info = {
            "steps": self._steps,
            "unsafe": report.unsafe,
            "ineffective": report.ineffective,
            "stopped": report.stopped,
            **_ends(outcome),
            "terms": terms,
            "strict": {**_ends(strict), "reward": sum(float(term) for term in strict.terms.values())},
        }
        terminated = bool(outcome.success | outcome.failure)
        truncated = not terminated and self._steps >= self.maximum_steps
        return _as_dict(observation), sum(terms.values()), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return a colour image of the table [400, 800, 3] in mode rgb_array, as one sees it who faces the robot."""
        return self.scene.photograph(SPECTATOR) if self.render_mode == "rgb_array" else None

    def pixels(self, centers: NDArray[np.floating]) -> NDArray[np.float64]:
        return SPECTATOR.project(centers)

    @property
    def names(self) -> list[str]:
        """See `World`: "can" of ycb/tomato_soup_can."""
        return [re.split("[_/]", one.name)[-1].removesuffix("s") for one in self.scene.objects]

    @property
    def landmarks(self) -> dict[str, NDArray[np.floating]]:
        """See `World`: at the lower edge of a single tile, of several tiles beside the one nearest to the spectator."""
        groups = self.task.tile_groups()
        places = {one.name: (*max(one.tiles), *((0.4, 0) if len(one.tiles) == 1 else (0, 1.1))) for one in groups}
        return {name: np.array([*tile_center((i + di, j + dj)), 0.0]) for name, (i, j, di, dj) in places.items()}

    def arrows(self, actions: NDArray[np.floating], centers: NDArray[np.floating]) -> NDArray[np.floating]:
        """See `World`: the tool's paths on the table."""
        ends = np.stack(push_endpoints(actions), axis=1)
        return np.concatenate([ends, np.zeros_like(ends[..., :1])], axis=-1)

    @property
    def name(self) -> str:
        return self.task.name

    def check_starts(self, seed: int) -> None:
        """See `World`: in every layout."""
        for number in range(len(self.tasks)):
            self.reset(seed=seed, options={"layout": number})
        if len(self.tasks) > 1:
            self.reset(seed=seed)  # in the layout that the seed samples

    def state(self, observation: Mapping[str, NDArray[Any]]) -> State:
        """See `World` and `state_of`."""
        if not callable(self.geometry):
            raise ValueError(
                "the table's state needs a checkpoint's geometry: make_env(..., geometry=load(NAME).geometry)"
            )
        return state_of(observation, self.geometry)

    def observed(self, observation: Mapping[str, NDArray[Any]]) -> ObservedPoints:
        return ObservedPoints.of(observation)

    def positions(self, observation: Mapping[str, NDArray[Any]]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        return observation["centers"], observation["mask"].astype(np.bool_)

    def goal(self, device: str | torch.device = "cpu") -> TaskReward:
        """The task's reward with the margin: one object for each of `tasks`, which keeps what it has computed."""
        known, key = self._goals if any(self.task is one for one in self.tasks) else {}, (id(self.task), str(device))
        if key not in known:
            known[key] = TaskReward(self.task, reward=self._rules[0], margin=self.margin, device=device)
        return known[key]

    def goals(self) -> NDArray[np.float64]:
        return self.task.goals()

    def move_goals(self, goals: NDArray[np.float64]) -> None:
        """See `World`: by whole tiles, where the goal is made of them."""
        assert self._observation is not None
        target = self._observation.centers[0, :2]
        self._begin(self.task.moved(goals, (float(target[0]), float(target[1]))))
        self.scene.markings, self.scene.places = self.task.tile_groups(), self.task.object_places()

    def close(self) -> None:
        self._observation = None
        self.scene.close()

    def _begin(self, task: Task) -> None:
        """Use a task and its rewards."""
        reward, criterion = self._rules
        self.task, self.reward = task, TaskReward(task, reward=reward, criterion=criterion)
        self._strict_reward = TaskReward(task, reward=reward)

    def _can_start(self, layout: Task, generator: np.random.Generator, observation: Observation) -> bool:
        """Take the task of the episode that would begin so; whether it has not already ended."""
        task = layout.of_episode(observation, generator)
        if task is not layout:
            self._begin(task)
        outcome = _judged(self._strict_reward, observation, observation)
        return not bool(outcome.success | outcome.failure)


@torch.inference_mode()
def state_of(observation: Mapping[str, NDArray[Any]], geometry: Geometry) -> State:
    """The state `[]` of an observation, without needless padding.

    `observation`: `centers`, `clouds` and `mask` of `Observation`, [M, ...]. `geometry`: on the CPU. Raises ValueError:
    no object, or numbers of one that are not finite.
    """
    real = np.flatnonzero(observation["mask"])
    for name in ("clouds", "centers"):
        if not (observation[name][real].size and np.isfinite(observation[name][real]).all()):
            raise ValueError(f"{name} of an observation must be finite numbers of at least one object")
    objects = int(real.max()) + 1
    centers = torch.from_numpy(observation["centers"][:objects])
    clouds = torch.from_numpy(observation["clouds"][:objects]) - centers[:, None]
    mask = torch.from_numpy(observation["mask"][:objects].astype(np.bool_))
    return State(centers, geometry(clouds), mask)


def _judged(reward: TaskReward, before: Observation, after: Observation, *, fallen: bool = False) -> Outcome:
    previous, centers = (torch.from_numpy(one.centers) for one in (before, after))
    return reward(previous, centers, torch.from_numpy(after.mask), fallen=fallen)


def _ends(outcome: Outcome) -> dict[str, bool]:
    return {name: bool(getattr(outcome, name)) for name in ("success", "violation", "fall")}


def _areas(tiles: TileSet, jitter: float) -> Area:
    centers = [tile_center(tile) for tile in tiles]
    return [((x - jitter, y - jitter), (x + jitter, y + jitter)) for x, y in centers]


def _as_dict(observation: Observation) -> ObservationDict:
    return {
        "clouds": observation.clouds.copy(),  # a copy: changes by the caller must not affect the next step's reward
        "centers": observation.centers.copy(),
        "mask": observation.mask.astype(np.int8),
        "visible": observation.visible.astype(np.int8),
    }
