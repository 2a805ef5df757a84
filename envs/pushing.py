"""The Gymnasium environment: a scene, a task's reward, and when an episode ends."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from envs.camera import Camera
from envs.layouts import Layout, Tile
from envs.markings import tile_groups
from envs.object_asset import plain_name
from envs.object_sets import load_object_set
from envs.objects import Area, ObjectRanges
from envs.observation import Observation
from envs.random_layouts import possible_layouts
from envs.randomness import layout_stream, next_scene_stream
from envs.scene import Scene
from envs.sensors import DepthSensor
from envs.tasks import GOAL_REWARD, TIME_REWARD, VIOLATION_REWARD, Outcome, TaskReward
from envs.workspace import MAXIMUM_OBJECTS, POINTS_PER_OBJECT, TILE_SIDE, tile_center

EPISODE_STEPS = 60
TARGET_JITTER = 0.05  # metres; how far from its tile's centre the target may start, on each axis
OBSTACLE_JITTER = TILE_SIDE / 2  # metres; obstacles start anywhere on their tiles
VIDEO_SIZE = (512, 424)  # pixels

ObservationDict = dict[str, NDArray[Any]]


class PushingEnv(gymnasium.Env[ObservationDict, NDArray[np.float32]]):
    """Push objects on a table until a task's goal is reached, seen by a depth camera from above.

    Observation: `clouds` [5, 256, 3] metres, `centers` [5, 3] metres, `mask` [5] (known objects, object 0 is
    the target), `visible` [5] (objects in the current image). Action: one push (x, y, dx, dy) in [-1, 1].

    `info` of a reset: `steps`, which is 0, and the episode's `layout`, from which `envs.tasks.TaskReward` makes its
    reward. `info` of a step: `steps` so far, `unsafe` and `ineffective` pushes, `stopped` (why the robot ended the push
    early: "unreachable" and not begun, "blocked" by something in its way, contact with the "table"; "" if it did
    not), `success`, `violation`, `fall`, and `terms`, the named parts of the reward. An episode terminates at
    success, violation or fall, and is truncated after `maximum_steps`.

    Args:
        task, layout, tiles: see `envs.random_layouts.possible_layouts`; `tiles` replaces fields of the layout. A
            `Layout` is taken as it is, and its task counts. `layout="random"` is drawn anew at every reset.
        reward: dense or sparse. objects: how many, 1 to 5. ranges: object parameters.
        robot: what pushes, one of `envs.robots.ROBOTS`.
        object_set: where the objects come from, a key of `envs.object_sets.OBJECT_SETS`.
        camera, segmentation: see `envs.scene.Scene`.
        assets: folder of meshes, for robots and sets that need one.
        maximum_steps: pushes per episode. show_tiles: whether pictures show the layout on the table.

    Raises:
        ValueError: an argument is out of its range, the layout has no room for the objects, or the robot's files
            are missing.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        *,
        task: str = "crossing",
        layout: int | str | Path | Layout = 0,
        tiles: Mapping[str, Any] | None = None,
        reward: str = "sparse",
        objects: int = 3,
        ranges: ObjectRanges | None = None,
        object_set: str = "builtin",
        assets: str | Path | None = None,
        maximum_steps: int = EPISODE_STEPS,
        camera: str | Camera | DepthSensor = "ideal",
        segmentation: str = "mask",
        render_mode: str | None = None,
        show_tiles: bool = True,
        robot: str = "stick",
    ) -> None:
        if objects not in range(1, MAXIMUM_OBJECTS + 1):
            raise ValueError(f"objects must be a whole number from 1 to {MAXIMUM_OBJECTS}, not {objects}")
        if maximum_steps < 1:
            raise ValueError(f"maximum_steps must be at least 1, not {maximum_steps}")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}: choose rgb_array or None")
        if isinstance(layout, Layout) and tiles:
            raise ValueError("tiles replace fields of a layout that is read: give its number or path, or no tiles")
        self.layouts = (layout,) if isinstance(layout, Layout) else possible_layouts(task, layout, tiles)
        self._rewards = [TaskReward(one, reward=reward) for one in self.layouts]
        self.layout, self.reward = self.layouts[0], self._rewards[0]  # of the episode
        self.objects, self.maximum_steps, self.render_mode = int(objects), maximum_steps, render_mode
        self.show_tiles = show_tiles
        available = load_object_set(object_set, assets)
        self.ranges = ranges or ObjectRanges(names=tuple(dict.fromkeys(map(plain_name, available.names))))
        self.scene = Scene(camera=camera, segmentation=segmentation, object_set=available, robot=robot, assets=assets)
        shape = (MAXIMUM_OBJECTS, POINTS_PER_OBJECT, 3)
        # Gymnasium declares that a Dict space's elements are spaces.
        self.observation_space = gymnasium.spaces.Dict(  # type: ignore[assignment]
            {
                "clouds": gymnasium.spaces.Box(-10.0, 10.0, shape, np.float32),
                "centers": gymnasium.spaces.Box(-10.0, 10.0, (MAXIMUM_OBJECTS, 3), np.float32),
                "mask": gymnasium.spaces.MultiBinary(MAXIMUM_OBJECTS),
                "visible": gymnasium.spaces.MultiBinary(MAXIMUM_OBJECTS),
            }
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self._seen: Observation | None = None
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationDict, dict[str, Any]]:
        """Draw a layout, and a scene in which the episode has not ended before it began.

        Args:
            options: `layout`, which of the environment's `layouts` to take instead of a random one.

        Raises:
            ValueError: the layout has no room for the objects, or there is no layout of that number.
        """
        super().reset(seed=seed)
        scene_generator = next_scene_stream(self.np_random)
        drawn = int(layout_stream(scene_generator).integers(len(self.layouts)))
        number = (options or {}).get("layout", drawn)
        if number not in range(len(self.layouts)):
            raise ValueError(f"no layout {number} to reset to: choose from 0 to {len(self.layouts) - 1}")
        self.layout, self.reward = self.layouts[number], self._rewards[number]
        self.scene.markings = tile_groups(self.layout) if self.show_tiles else ()
        target = _areas(self.layout.target_start, TARGET_JITTER)
        obstacle = _areas(self.layout.obstacle_start, OBSTACLE_JITTER)
        areas = [target, *[obstacle] * (self.objects - 1)]
        self._seen = self.scene.draw(areas, self.ranges, scene_generator, acceptable=self._can_start)
        self._steps = 0
        return _as_dict(self._seen), {"steps": 0, "layout": self.layout}

    def step(self, action: NDArray[np.float32]) -> tuple[ObservationDict, float, bool, bool, dict[str, Any]]:
        """Push, wait until the objects rest, look, and judge.

        Raises:
            ValueError: the action is not four finite numbers.
            RuntimeError: called before `reset`.
        """
        if self._seen is None:
            raise RuntimeError("call reset() before step()")
        report = self.scene.push(np.asarray(action))
        seen = self.scene.observe()
        outcome = self._judge(self._seen, seen)
        fallen = report.fallen or bool(outcome.fall)
        success, violation = bool(outcome.success) and not fallen, bool(outcome.violation) and not fallen
        terms = {
            "goal": GOAL_REWARD * success,
            "violation": VIOLATION_REWARD * (violation or fallen),
            "time": TIME_REWARD,
            "progress": float(outcome.progress) if self.reward.dense else 0.0,
        }
        self._seen = seen
        self._steps += 1
        info = {
            "steps": self._steps,
            "unsafe": report.unsafe,
            "ineffective": report.ineffective,
            "stopped": report.stopped,
            "success": success,
            "violation": violation,
            "fall": fallen,
            "terms": terms,
        }
        terminated = success or violation or fallen
        truncated = not terminated and self._steps >= self.maximum_steps
        return _as_dict(seen), sum(terms.values()), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """A colour image of the table [424, 512, 3] in mode rgb_array."""
        if self.render_mode != "rgb_array":
            return None
        return self.scene.photograph(self.scene.camera.resized(*VIDEO_SIZE))

    def close(self) -> None:
        """Free the simulator."""
        self.scene.close()

    def _judge(self, before: Observation, after: Observation) -> Outcome:
        previous, centers = (torch.from_numpy(seen.centers) for seen in (before, after))
        return self.reward(previous, centers, torch.from_numpy(after.mask))

    def _can_start(self, seen: Observation) -> bool:
        outcome = self._judge(seen, seen)
        return not bool(outcome.success | outcome.failure)


def _areas(tiles: tuple[Tile, ...], jitter: float) -> Area:
    centers = [tile_center(tile) for tile in tiles]
    return [((x - jitter, y - jitter), (x + jitter, y + jitter)) for x, y in centers]


def _as_dict(seen: Observation) -> ObservationDict:
    return {
        "clouds": seen.clouds.copy(),  # what a caller does to them must not change the next step's reward
        "centers": seen.centers.copy(),
        "mask": seen.mask.astype(np.int8),
        "visible": seen.visible.astype(np.int8),
    }
