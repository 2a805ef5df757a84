"""The planner's reward, also for episodes with different layouts or goals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from envs.tasks import Outcome, Task, TaskReward


class TaskSource(Protocol):
    """The part of `envs.pushing.PushingEnv` that a planner may use: its tasks, without the world."""

    @property
    def tasks(self) -> Sequence[Task]:
        """The tasks that an episode may have, each in its layout."""

    @property
    def task(self) -> Task:
        """The task of the episode: one of `tasks`, or what its `of_episode` returned."""


class EpisodeReward:
    """`envs.tasks.TaskReward` of the task of the environment's episode; a planner is built with it once.

    Every call reads the environment's `task`, so the tiles and the goal are always those of the current episode.

    Args:
        env: whose episodes are planned. reward: dense or sparse. margin: metres, as of `TaskReward`.

    Raises:
        ValueError: as `TaskReward` does.
    """

    def __init__(self, env: TaskSource, *, reward: str, margin: float) -> None:
        self._env = env
        self._rewards = [TaskReward(task, reward=reward, margin=margin) for task in env.tasks]
        self._own: TaskReward | None = None  # of a goal that only this episode has
        self.dense, self.margin = reward == "dense", margin

    @property
    def task(self) -> Task:
        """The task of the current episode, in its layout."""
        return self._env.task

    @property
    def current(self) -> TaskReward:
        """The reward of the current episode: a pure function of tensors."""
        task = self.task
        if task in self._env.tasks:
            return self._rewards[self._env.tasks.index(task)]
        if self._own is None or self._own.task != task:
            self._own = TaskReward(task, reward="dense" if self.dense else "sparse", margin=self.margin)
        return self._own

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> Outcome:
        """Evaluate the step `previous: [..., M, 3]` to `centers: [..., M, 3]` metres; `mask: [..., M]` bool."""
        return self.current(previous, centers, mask)
