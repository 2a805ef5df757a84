"""Steps of an episode, real or predicted: positions of objects before and after.

Tensors may have any leading dimensions `[...]`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from envs.tasks.tiles import box_distance, table_distance
from envs.workspace import REACH_HIGH, REACH_LOW

STILL = 0.005  # metres; what moves by less is taken to stay where it is

Depth = Callable[[Tensor], Tensor]
"""Metres from points [..., 2] to the border of a forbidden place, positive within it: [...]."""


class Step(NamedTuple):
    """Planar centres of objects in T + 1 successive states, with a push from each to the next; object 0 is the target.

    A task evaluates all T steps at once: [..., T]. The environment evaluates T = 1 step at a time, planners whole
    segments, so that no state is evaluated twice.

    Attributes:
        states: [..., T + 1, M, 2] metres. mask: [..., 1, M] bool, True for real objects.
        margin: safety margin in metres, for planners; else 0.
    """

    states: Tensor
    mask: Tensor
    margin: float

    @property
    def before(self) -> Tensor:
        """Positions before the push: [..., T, M, 2] metres."""
        return self.states[..., :-1, :, :]

    @property
    def after(self) -> Tensor:
        """Positions after the push: [..., T, M, 2] metres."""
        return self.states[..., 1:, :, :]

    @property
    def target(self) -> Tensor:
        """Position of the target after the push: [..., T, 2] metres."""
        return self.after[..., 0, :]

    def target_enters(self, depth: Depth) -> Tensor:
        """Whether the target is in a forbidden place: [..., T] bool.

        Within the margin around that place, an object may stay where it is or move away, but come no closer.
        """
        return self._enters(depth, self.states[..., :1, :]).squeeze(-1)

    def any_enters(self, depth: Depth) -> Tensor:
        """Whether any real object is in a forbidden place, with the margin as in `target_enters`: [..., T] bool."""
        return (self._enters(depth, self.states) & self.mask).any(dim=-1)

    def any_leaves_reach(self, arrived: Callable[[Tensor], Tensor]) -> Tensor:
        """Whether a push moves any real object out of the tool's reach, the margin included, or farther: [..., T] bool.

        By more than `STILL`: predictions of an object that nothing touches differ by less. What lies there may stay.

        Args:
            arrived: whether objects at points [..., M, 2] have arrived, where it does not matter: [..., M] bool.
        """
        depths = torch.where(arrived(self.states), -torch.inf, _out_of_reach(self.states))
        before, after = depths[..., :-1, :], depths[..., 1:, :]
        return ((after > -self.margin) & (after > before + STILL) & self.mask).any(dim=-1)

    def all_within(self, depth: Depth) -> Tensor:
        """Whether every real object is more than the margin within a place, by its `depth`: [..., T] bool."""
        return ~(~(depth(self.after) > self.margin) & self.mask).any(dim=-1)

    def _enters(self, depth: Depth, states: Tensor) -> Tensor:
        """Of each object in `states: [..., T + 1, M, 2]`: [..., T, M] bool."""
        if self.margin == 0.0:
            return depth(states[..., 1:, :, :]) > 0.0
        depths = depth(states)  # once per state, although a state is after one push and before the next
        before, after = depths[..., :-1, :], depths[..., 1:, :]
        return (after > 0.0) | ((after > -self.margin) & (after > before))


def off_table(points: Tensor) -> Tensor:
    """Metres by which points [..., 2] lie off the table, negative on it: [...]."""
    return -table_distance(points)


def _out_of_reach(points: Tensor) -> Tensor:
    """Metres by which points [..., 2] lie outside the box that the tool's tip reaches, negative within: [...]."""
    return -box_distance(points, REACH_LOW, REACH_HIGH)
