"""What a domain must say, so that models learn it and planners reach goals in it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State

GOAL_REWARD = 100.0
STEP_REWARD = -1.0

Geometry = Callable[[Tensor], Tensor]
"""What makes a feature of each object's point cloud: `[..., points, 3]` -> `[..., F]`."""


class Policy(Protocol):
    """What chooses the actions of collected episodes."""

    def act(self, observation: Any) -> NDArray[Any]:
        """The next action `[A]` in [-1, 1]."""


class World(gymnasium.Env[Any, NDArray[np.float32]], ABC):
    """An environment of Gymnasium that models can learn and planners can act in.

    Its actions are a box [-1, 1] of A numbers; repeats of an action are hidden in `step`. `info` of a step has
    `success`, and an episode that ends without it has failed. Besides `reset` and `step` a world says:

    space       dimensions, units and ranges of states and actions
    features    F, numbers of an object's feature. objects: M
    state       of an observation
    goal        of the current episode
    policy      that collects; a world whose data come from elsewhere has none
    decimals    to which a plan's actions are rounded; None: as they are
    pixels      where positions lie in the picture of `render`, for drawings; None: they are drawn on axes
    """

    space: ClassVar[Space]
    features: ClassVar[int]
    objects: ClassVar[int]
    decimals: ClassVar[int | None] = 3

    @abstractmethod
    def state(self, observation: Any, geometry: Geometry | None = None) -> State:
        """The state `[]` of one observation: centres `[M, P]`, features `[M, F]`, mask `[M]`, float32.

        `geometry`: of the checkpoint, in worlds that see point clouds.
        """

    @property
    @abstractmethod
    def goal(self) -> Goal:
        """Of the current episode."""

    def policy(self, generator: np.random.Generator) -> Policy:
        """What collects an episode; `generator`: all of its randomness.

        Raises:
            ValueError: this world collects none.
        """
        raise ValueError(f"{type(self).__name__} has no policy that collects: train on data from elsewhere")

    def pixels(self, centers: NDArray[np.floating]) -> NDArray[np.float64] | None:
        """Columns and rows `[..., 2]` of positions `[..., P]` in the picture of `render`."""
        return None


class Outcome(NamedTuple):
    """The outcome of steps, in any batch `[...]`."""

    reward: Tensor
    success: Tensor
    failure: Tensor


class Goal(ABC):
    """The goal of an episode, as planners see it, from the whole state.

    reward = 100 at success, -100 at failure, -1 each step, and `weight` times the decrease of `distance`

    Args:
        space: of the world. weight: of progress; 0 is a sparse reward.
    """

    reads_features = True
    about = "all"

    def __init__(self, space: Space, *, weight: float = 0.0) -> None:
        self.space, self.weight = space, weight

    @abstractmethod
    def success(self, state: State) -> Tensor:
        """Whether states `[...]` are at the goal: `[...]` bool."""

    def failure(self, state: State) -> Tensor:
        """Whether states `[...]` end the episode without success: `[...]` bool; by default never."""
        return torch.zeros_like(state.mask[..., 0])

    def distance(self, state: State) -> Tensor:
        """What is left to the goal from states `[...]`: `[...]`; by default nothing, for sparse rewards."""
        return torch.zeros_like(state.centers[..., 0, 0])

    @property
    def maximum_return(self) -> float:
        """Upper bound on any return; infinite where progress counts."""
        return math.inf if self.weight else GOAL_REWARD + STEP_REWARD

    def distance_to_goal(self) -> None:
        """None: guidance has no map of this world."""

    def __call__(self, previous: Tensor, values: Tensor, mask: Tensor) -> Outcome:
        """The outcome of steps from `previous` to `values: [..., M, P + F]`, `mask: [..., M]`: `[...]`."""
        state = self._state(values, mask)
        success = self.success(state)
        failure = self.failure(state) & ~success
        reward = STEP_REWARD + GOAL_REWARD * (success.float() - failure.float())
        if self.weight:
            reward = reward + self.weight * (self.distance(self._state(previous, mask)) - self.distance(state))
        return Outcome(reward, success, failure)

    def along(self, values: Tensor, mask: Tensor) -> Outcome:
        """The outcomes of the T steps of paths `values: [..., T + 1, M, P + F]`, `mask: [..., M]`: `[..., T]`."""
        previous, after = values[..., :-1, :, :], values[..., 1:, :, :]
        return self(previous, after, mask.unsqueeze(-2).expand(after.shape[:-1]))

    def _state(self, values: Tensor, mask: Tensor) -> State:
        size = self.space.positions
        return State(values[..., :size], values[..., size:], mask)
