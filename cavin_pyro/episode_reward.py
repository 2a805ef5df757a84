"""The planner's reward where every episode may have a layout of its own."""

from __future__ import annotations

from torch import Tensor

from envs.layouts import Layout
from envs.pushing import PushingEnv
from envs.tasks import Outcome, TaskReward


class EpisodeReward:
    """`envs.tasks.TaskReward` of the layout that the environment's episode has; a planner is built with it once.

    It looks at the environment's `layout` at every call, so that no planner can judge by the tiles of an earlier
    episode, and at nothing else of it: what a task wants is told to a planner, where objects are is not.

    Args:
        env: whose episodes are planned. reward: dense or sparse. margin: metres, as of `TaskReward`.

    Raises:
        ValueError: as `TaskReward` does.
    """

    def __init__(self, env: PushingEnv, *, reward: str, margin: float) -> None:
        self._env = env
        self._rewards = {layout: TaskReward(layout, reward=reward, margin=margin) for layout in env.layouts}
        self.dense, self.margin = reward == "dense", margin

    @property
    def layout(self) -> Layout:
        """Of the episode."""
        return self._env.layout

    @property
    def now(self) -> TaskReward:
        """Of the episode: a pure function of tensors."""
        return self._rewards[self.layout]

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> Outcome:
        """Judge the step `previous: [..., M, 3]` to `centers: [..., M, 3]` metres; `mask: [..., M]` bool."""
        return self.now(previous, centers, mask)
