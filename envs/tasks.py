"""What a task rewards: one implementation for the real environment and for imagined states.

Pure functions on tensors with any leading dimensions, written from the paper's section 4.1 and its appendix
"Task Details": +100 at the goal, -100 for a violation, -1 per step, and for dense rewards the target's
progress in metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial, reduce
from operator import or_
from typing import NamedTuple

import torch
from torch import Tensor

from envs.layouts import Layout
from envs.tiles import TileSet, table_distance

GOAL_REWARD = 100.0
VIOLATION_REWARD = -100.0
TIME_REWARD = -1.0
REWARD_NAMES = ("dense", "sparse")


class Outcome(NamedTuple):
    """What one step of a task came to; every field is [...].

    Attributes:
        reward: the sum of the terms. progress: metres towards the goal, the dense term; zero where rewards are sparse.
        success, violation, fall: bool, at most one is true.
    """

    reward: Tensor
    progress: Tensor
    success: Tensor
    violation: Tensor
    fall: Tensor

    @property
    def failure(self) -> Tensor:
        """Whether the step ended the episode badly: [...] bool."""
        return self.violation | self.fall


class TaskReward:
    """The reward function of one task in one layout.

    Args:
        layout: tiles and task. reward: dense or sparse.
        margin: metres by which to be stricter than the task itself, for those who plan under uncertainty:
            forbidden places, and the region to clear, grow. An object that starts within the margin may stay there,
            but come no closer to what is forbidden.

    Raises:
        ValueError: unknown kind of reward, or a negative margin.
    """

    def __init__(self, layout: Layout, *, reward: str = "sparse", margin: float = 0.0) -> None:
        if reward not in REWARD_NAMES:
            raise ValueError(f"unknown reward {reward!r}: choose from {', '.join(REWARD_NAMES)}")
        if not margin >= 0.0:
            raise ValueError(f"margin must be at least 0 metres, not {margin}")
        self.layout, self.dense, self.margin = layout, reward == "dense", margin
        self._region = TileSet(layout.region)
        self._goal = TileSet(layout.goal) if layout.goal else None

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> Outcome:
        """Judge one step.

        Args:
            previous, centers: [..., M, 3] metres before and after the step; object 0 is the target.
            mask: [..., M] bool, True for real objects.
        """
        before, after = torch.broadcast_tensors(previous[..., :2], centers[..., :2])
        fall = _of_any(partial(self._entered, _off_table), before, after, mask)
        if self.layout.task == "clearing":
            violation = torch.zeros_like(fall)
            success = ~_of_any(lambda _, now: ~(self._region.signed_distance(now) > self.margin), before, after, mask)
        elif self.layout.task == "insertion":
            violation = _of_any(partial(self._entered, self._inside_region), before, after, mask)
            success = self._arrived(after[..., 0, :])
        else:
            violation = self._entered(self._region.signed_distance, before[..., 0, :], after[..., 0, :])
            success = self._arrived(after[..., 0, :])
        violation = violation & ~fall
        success = success & ~fall & ~violation
        reward = TIME_REWARD + GOAL_REWARD * success + VIOLATION_REWARD * (violation | fall)
        progress = torch.zeros_like(reward)
        if self.dense:
            progress = self.potential(after, mask) - self.potential(before, mask)
            reward = reward + progress
        return Outcome(reward.to(centers.dtype), progress, success, violation, fall)

    @property
    def most(self) -> float:
        """What no sequence of steps, which a success ends, earns more than; infinite where progress counts."""
        return math.inf if self.dense else TIME_REWARD + GOAL_REWARD

    def potential(self, positions: Tensor, mask: Tensor) -> Tensor:
        """Minus the metres still to go, whose change is the dense term: [...].

        Insertion and crossing: the target's distance to the goal's nearest tile centre. Clearing has virtual
        goals at the table's edges: the sum, over objects still in the region, of their distance to the
        nearest edge.

        Args:
            positions: [..., M, 2] metres. mask: [..., M] bool.
        """
        if self._goal is not None:
            centers = self._goal.centers.to(positions)
            return -(positions[..., 0, None, :] - centers).norm(dim=-1).amin(dim=-1)
        remaining = self._region.contains(positions) & mask
        return -torch.where(remaining, table_distance(positions), 0.0).sum(dim=-1)

    def _entered(self, depth: Callable[[Tensor], Tensor], before: Tensor, after: Tensor) -> Tensor:
        """Whether points [..., 2] are forbidden now, or draw nearer to what is forbidden within the margin: [...].

        `depth` of points [..., 2] is in metres, positive where it is forbidden.
        """
        now = depth(after)
        entered = now > 0.0
        if self.margin == 0.0:
            return entered
        near = (now > -self.margin) & ~entered
        if torch.compiler.is_compiling():  # compiled code has no branches, and a second look costs it little
            return entered | (near & (now > depth(before)))
        if bool(near.any()):  # the place before counts only there, and few points are there
            closer = now[near] > depth(before[near])
            entered = entered.masked_scatter(near, closer)
        return entered

    def _inside_region(self, points: Tensor) -> Tensor:
        return -self._region.signed_distance(points)

    def _arrived(self, target: Tensor) -> Tensor:
        assert self._goal is not None
        return self._goal.contains(target)


def _of_any(holds: Callable[[Tensor, Tensor], Tensor], before: Tensor, after: Tensor, mask: Tensor) -> Tensor:
    """Whether `holds` is true of any real object: [...]. before, after: [..., M, 2] metres. mask: [..., M] bool."""
    if torch.compiler.is_compiling():  # an object at a time: native code then takes many scenes at once
        objects = zip(before.unbind(-2), after.unbind(-2), mask.unbind(-1), strict=True)
        return reduce(or_, [holds(*where) & real for *where, real in objects])
    return (holds(before, after) & mask).any(dim=-1)


def _off_table(points: Tensor) -> Tensor:
    return -table_distance(points)
