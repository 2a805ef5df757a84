"""The planner's reward, also for episodes with different layouts or goals."""

from __future__ import annotations

import torch
from torch import Tensor

from cavin_pyro.envs.pushing import PushingEnv
from cavin_pyro.envs.tasks import Outcome, Task, TaskReward


class EpisodeReward:
    """`cavin_pyro.envs.tasks.TaskReward` of the task of the environment's episode; a planner is built with it once.

    Every call reads the environment's `task`, so the tiles and the goal are always those of the current episode.

    Args:
        env: whose episodes are planned. reward: dense or sparse. margin: metres, as in `TaskReward`.
        device: where plans are made.

    Raises:
        ValueError: as `TaskReward` does.
    """

    def __init__(self, env: PushingEnv, *, reward: str, margin: float, device: str | torch.device = "cpu") -> None:
        self._env, self._kind, self._device = env, reward, device
        self.dense, self.margin = reward == "dense", margin
        # With each reward its task, which must live as long: another one could get its number.
        self._rewards = {id(task): (task, self._reward_of(task)) for task in env.tasks}

    @property
    def task(self) -> Task:
        """The task of the current episode, in its layout."""
        return self._env.task

    @property
    def current(self) -> TaskReward:
        """The reward of the current episode: a pure function of tensors."""
        if id(self.task) not in self._rewards:  # a layout or a goal that only this episode has
            self._rewards = {id(self.task): (self.task, self._reward_of(self.task))}
        return self._rewards[id(self.task)][1]

    def _reward_of(self, task: Task) -> TaskReward:
        return TaskReward(task, reward=self._kind, margin=self.margin, device=self._device)

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> Outcome:
        """Evaluate the step `previous: [..., M, 3]` to `centers: [..., M, 3]` metres; `mask: [..., M]` bool."""
        return self.current(previous, centers, mask)
