"""A world of a point in a square, for tests: its action is its motion, and the goal is the right side."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from torch import Tensor

from cavin_pyro.envs.world import Goal, World
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State


class RightSide(Goal):
    def success(self, state: State) -> Tensor:
        return state.centers[..., 0, 0] > 0.9


class Wanders:
    def __init__(self, generator: np.random.Generator) -> None:
        self._generator = generator

    def act(self, observation: np.ndarray) -> np.ndarray:
        return self._generator.uniform(-1, 1, 2)


class Point(World):
    """Its episodes end at the right side, if it `stops` there; with `wild` motions its policy leaves the box."""

    space: ClassVar[Space] = Space(origin=(0, 0), length=1, step_range=0.5, subgoal_range=1, action_sizes=(2,))
    features, objects, maximum_steps = 1, 1, 10
    action_space: Any = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, stops: bool = True, wild: float = 1.0, flaw: float = 1.0) -> None:
        self.stops, self.wild, self.flaw = stops, wild, flaw

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-0.9, 0.9, 2), 0
        return self.place, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.place = np.clip(self.place + 0.3 * action, -1, 1)
        done = bool(self.stops and self.place[0] > 0.9)
        self.steps += 1
        return self.place, 0.0, done, self.steps >= self.maximum_steps, {"success": done}

    def state(self, observation: Any) -> State:
        centers = torch.as_tensor(np.array(observation, np.float32) * self.flaw)[None]
        return State(centers, torch.ones(1, 1), torch.ones(1, dtype=torch.bool))

    def goal(self, device: Any = "cpu") -> Goal:
        return RightSide(self.space)

    def policy(self, generator: np.random.Generator) -> Wanders:
        policy = Wanders(generator)
        if self.wild != 1.0:
            policy.act = lambda observation: self.wild * np.ones(2)  # type: ignore[method-assign]
        return policy
