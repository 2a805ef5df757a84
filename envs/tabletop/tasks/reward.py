"""The reward of a task's steps: one implementation for the environment and for planners.

+100 at the goal, -100 for a violation, -1 per step, and for dense rewards the progress in metres (paper, section 4.1
and appendix "Task Details"). Pure functions on tensors with any leading dimensions.
"""

from __future__ import annotations

import math
from functools import reduce
from operator import add
from typing import NamedTuple

import torch
from torch import Tensor

from cavin_pyro.envs.tabletop.tasks.task import Step, Task
from cavin_pyro.envs.tabletop.tasks.tiles import DistanceField, grid, table_distance
from cavin_pyro.envs.tabletop.workspace import TABLE_HIGH, TABLE_LOW
from cavin_pyro.models.checks import check_choice, check_number

REWARD_NAMES = ("dense", "sparse")
CRITERIA = ("strict", "published")


class Outcome(NamedTuple):
    """The outcome of one step of a task; every tensor is [...].

    `reward`: the sum of the terms. `terms`: by name, see `Task.terms`. `success`, `violation`, `fall`: bool, at most
    one is true.
    """

    reward: Tensor
    terms: dict[str, Tensor]
    success: Tensor
    violation: Tensor
    fall: Tensor

    @property
    def failure(self) -> Tensor:
        """Whether the step ended the episode badly: [...] bool."""
        return self.violation | self.fall

    def step(self, index: int) -> Outcome:
        """One of several outcomes: `[..., T]` -> `[...]`."""
        reward, success, violation, fall = (
            field[..., index] for field in (self.reward, self.success, self.violation, self.fall)
        )
        return Outcome(reward, {name: term[..., index] for name, term in self.terms.items()}, success, violation, fall)


class DistanceToGoal:
    """The remaining distance to a task's goal: of the target, or the sum over all objects, as the task is `about`.

    It follows from the task's rules for a single object, which may be where no rule is broken, and has arrived where
    the task is solved. Other objects do not block it. If each object has a goal of its own, it is the distance in the
    task's `potential`.
    """

    def __init__(self, reward: TaskReward) -> None:
        self._all = reward.task.about == "all"
        self._own_goals = None if reward.task.goal_is_shared else reward.task
        if self._own_goals is not None:
            return
        outcome = outcome_alone(reward, grid())
        self._field = DistanceField(~outcome.failure, outcome.success, reward.device)

    def __call__(self, centers: Tensor, mask: Tensor) -> Tensor:
        """Metres left: [...], from centers [..., M, 3] metres and mask [..., M] bool; object 0 is the target."""
        if self._own_goals is not None:
            return -self._own_goals.potential(centers[..., :2], mask)
        if not self._all:
            return self._field(centers[..., 0, :2])
        return torch.where(mask, self._field(centers[..., :2]), 0.0).sum(-1)

    def longest(self, mask: Tensor) -> Tensor:
        """An upper bound on the metres left with the objects in mask [..., M] bool: [...]."""
        longest = math.dist(TABLE_LOW, TABLE_HIGH) if self._own_goals is not None else self._field.longest
        return longest * (mask.sum(-1) if self._all else torch.ones_like(mask[..., 0], dtype=torch.int64))


class TaskReward:
    """The reward function of a task.

    Args:
        task: in its layout. reward: dense or sparse.
        margin: safety margin in metres for planners, whose predictions err: forbidden regions, and regions to clear,
            grow; regions to stay within shrink. An object that starts within the margin may stay there, but must not
            come closer. With a margin, dead ends (`Task.dead_end`) are violations.
        criterion: which rules make a step a violation: `strict`, those of the paper (`Task.violation`), or `published`,
            those of the published implementation for real episodes (`Task.published_violation`).
        device: where the layout's numbers lie, best that of the tensors to evaluate.

    Raises ValueError: unknown kind of reward, unknown criterion, or a negative margin.
    """

    reads_features = False

    def __init__(
        self,
        task: Task,
        *,
        reward: str = "sparse",
        margin: float = 0.0,
        criterion: str = "strict",
        device: str | torch.device = "cpu",
    ) -> None:
        check_choice("reward", reward, REWARD_NAMES)
        check_choice("criterion", criterion, CRITERIA)
        check_number("margin", margin)
        self.device = torch.device(device)
        self.task, self.dense, self.margin = task.to(self.device), reward == "dense", margin
        self.criterion, self.about = criterion, task.about
        self._distance: DistanceToGoal | None = None

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor, *, fallen: bool = False) -> Outcome:
        """Evaluate one step: [...].

        Args:
            previous, centers: [..., M, 3] metres before and after the step; object 0 is the target.
            mask: [..., M] bool, True for real objects.
            fallen: whether an object has left the table according to the simulator.
        """
        states = torch.stack(torch.broadcast_tensors(previous, centers), -3)
        return self.along(states, mask, fallen=fallen).step(0)

    def along(self, states: Tensor, mask: Tensor, *, fallen: bool = False) -> Outcome:
        """Evaluate all T steps of paths, equal to one call per step, but faster: [..., T].

        `states`: [..., T + 1, M, 3] metres, the state before the first step included; object 0 is the target. `mask`:
        [..., M] bool, True for real objects. `fallen`: as for one step.
        """
        step = Step(states[..., :2], mask.unsqueeze(-2), self.margin)
        fall = step.any_enters(lambda points: -table_distance(points))
        if fallen:
            fall = torch.ones_like(fall)
        violated = self.task.violation if self.criterion == "strict" else self.task.published_violation
        violation = violated(step)
        if self.margin:
            violation = violation | self.task.dead_end(step)
        violation = violation & ~fall
        success = self.task.success(step) & ~fall & ~violation
        terms = self.task.terms(step, success, violation | fall, dense=self.dense)
        reward = reduce(add, terms.values())
        return Outcome(reward.to(states.dtype), terms, success, violation, fall)

    def distance_to_goal(self) -> DistanceToGoal:
        """The remaining distance to the goal, for planners, with the margin. Computing it takes about 0.1 s, once."""
        self._distance = self._distance or DistanceToGoal(self)
        return self._distance

    @property
    def maximum_return(self) -> float:
        """Upper bound on the return of any episode; infinite where progress counts."""
        return math.inf if self.dense else self.task.maximum_return


def outcome_alone(reward: TaskReward, points: Tensor) -> Outcome:
    """The outcome for one object alone, at rest at each of the points [..., 2] metres: [...]."""
    alone = torch.cat([points, torch.zeros_like(points[..., :1])], -1).unsqueeze(-2)
    return reward(alone, alone, torch.ones_like(alone[..., 0], dtype=torch.bool))
