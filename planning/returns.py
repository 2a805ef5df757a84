"""Cumulative reward of predicted trajectories (paper, section 3.2, "Effect-Level Plan"). Pure functions."""

from __future__ import annotations

from functools import reduce
from itertools import accumulate
from operator import or_
from typing import NamedTuple

import torch
from torch import Tensor

from planning.protocol import RewardFunction


class Progress(NamedTuple):
    """Where plans stand, in any batch `[...]`. A plan that has succeeded or failed earns no more."""

    returns: Tensor  # [...] cumulative reward so far; -inf once a prediction or a reward was not finite
    succeeded: Tensor  # [...] bool
    failed: Tensor  # [...] bool, never together with `succeeded`
    segments: Tensor  # [...] int64: segments entered while active

    @property
    def active(self) -> Tensor:
        """`[...]` bool: neither succeeded nor failed."""
        return ~(self.succeeded | self.failed)

    def take_plans(self, index: Tensor) -> Progress:
        """Choose plans by number, per environment: fields `[B, N]`, `index: [B, n]` -> `[B, n]`."""
        return Progress(*(field.gather(1, index) for field in self))


def start(centers: Tensor) -> Progress:
    """Progress of plans that have not begun yet, for `centers: [..., M, 3]`: fields `[...]`."""
    shape = centers.shape[:-2]
    return Progress(
        returns=centers.new_zeros(shape),
        succeeded=centers.new_zeros(shape, dtype=torch.bool),
        failed=centers.new_zeros(shape, dtype=torch.bool),
        segments=centers.new_zeros(shape, dtype=torch.int64),
    )


def interpolate(start: Tensor, end: Tensor, steps: int) -> Tensor:
    """Straight, evenly timed path of T = `steps` states from `start` (not included) to `end` (included).

    `start`, `end`: `[..., M, 3]` metres -> `[..., T, M, 3]`, of which the last equals `end` exactly
    (Algorithm 1, line 6).
    """
    fraction = torch.arange(1, steps + 1, device=end.device, dtype=end.dtype) / steps
    return torch.lerp(start.unsqueeze(-3), end.unsqueeze(-3), fraction[:, None, None])


def before_each(start: Tensor, centers: Tensor) -> Tensor:
    """Where objects are before each of T steps: `start: [..., M, 3]`, after each `centers: [..., T, M, 3]` metres."""
    return torch.cat([start.unsqueeze(-3), centers[..., :-1, :, :]], dim=-3)


def advance(progress: Progress, reward: RewardFunction, start: Tensor, centers: Tensor, mask: Tensor) -> Progress:
    """Add the rewards of one segment up to and including the step that ends a plan.

    `progress`: fields `[...]`; `start: [..., M, 3]` metres, the state before the segment;
    `centers: [..., T, M, 3]` metres, the T states of the segment; `mask: [..., M]` bool.
    A step that is both a success and a failure is a failure. A step with a centre (of a real object) or a
    reward that is not finite is a failure of reward -inf, whatever the reward function says of it: no
    comparison holds for NaN, so "no object is in the region" would be a success.
    """
    states = torch.cat([start.unsqueeze(-3), centers], dim=-3)  # [..., T + 1, M, 3]
    step_mask = mask.unsqueeze(-2).expand(centers.shape[:-1])
    if torch.compiler.is_compiling():
        states, step_mask = (_plans_side_by_side(values, mask.ndim - 1) for values in (states, step_mask))
    previous, centers = states[..., :-1, :, :], states[..., 1:, :, :]
    outcome = reward(previous, centers, step_mask)
    # A sum is finite only where everything in it is.
    sound = torch.isfinite(outcome.reward + centers.where(step_mask.unsqueeze(-1), 0.0).sum((-2, -1)))
    failure = outcome.failure | ~sound
    ends = (failure | outcome.success).unbind(-1)
    ended_before = torch.stack([torch.zeros_like(ends[0]), *accumulate(ends[:-1], or_)], -1)
    counts = progress.active.unsqueeze(-1) & ~ended_before
    earned = torch.where(sound, outcome.reward, -torch.inf)
    return Progress(
        returns=progress.returns + torch.where(counts, earned, 0.0).sum(-1),
        succeeded=progress.succeeded | _at_any_step(counts & outcome.success & ~failure),
        failed=progress.failed | _at_any_step(counts & failure),
        segments=progress.segments + progress.active,
    )


def _at_any_step(steps: Tensor) -> Tensor:
    """`[..., T]` bool -> `[...]`. As native code faster than torch's `any`."""
    return reduce(or_, steps.unbind(-1))


def _plans_side_by_side(values: Tensor, batch_dimensions: int) -> Tensor:
    """The same `[B, n, ...]`; in memory, first come all plans' first numbers, then all plans' second ones.

    Native code then judges sixteen plans at a time.
    """
    numbers = values.flatten(batch_dimensions).movedim(-1, 0)
    apart = torch.cat([numbers[:1], numbers[1:]])  # what is joined is written to memory
    return apart.movedim(0, -1).unflatten(-1, values.shape[batch_dimensions:])
