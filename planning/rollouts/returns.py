"""Cumulative reward of predicted trajectories (paper, section 3.2, "Effect-Level Plan"). Pure functions."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from planning.protocol import Outcome, PathReward, RewardFunction


class Progress(NamedTuple):
    """The cumulative reward of candidates so far, in any batch `[...]`; a terminated candidate earns no more."""

    returns: Tensor  # [...] cumulative reward so far; -inf once a prediction or a reward was not finite
    succeeded: Tensor  # [...] bool
    failed: Tensor  # [...] bool, never together with `succeeded`
    segments: Tensor  # [...] int64: segments entered while active

    @property
    def earned(self) -> Tensor:
        """`[...]` cumulative reward, which is all that plans are ranked by without guidance."""
        return self.returns

    @property
    def active(self) -> Tensor:
        """`[...]` bool: neither succeeded nor failed."""
        return ~(self.succeeded | self.failed)


def start(centers: Tensor) -> Progress:
    """Progress of candidates without a step, for `centers: [..., M, 3]`: fields `[...]`."""
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
    """Positions before each of T steps: `start: [..., M, 3]`, after each `centers: [..., T, M, 3]` metres."""
    return torch.cat([start.unsqueeze(-3), centers[..., :-1, :, :]], dim=-3)


def advance(progress: Progress, reward: RewardFunction, start: Tensor, centers: Tensor, mask: Tensor) -> Progress:
    """Add the rewards of one segment up to and including the step that ends a plan.

    `progress`: fields `[...]`; `start: [..., M, 3]` metres, the state before the segment;
    `centers: [..., T, M, 3]` metres, the T states of the segment; `mask: [..., M]` bool.
    A step that is both a success and a failure is a failure. A step with a centre (of a real object) or a
    reward that is not finite is a failure with reward -inf, even if the reward function disagrees: no
    comparison holds for NaN, so "no object is in the region" would be a success.
    """
    states = torch.cat([start.unsqueeze(-3), centers], dim=-3)  # [..., T + 1, M, 3]
    outcome = judge(reward, states, mask)
    # A sum is finite only if all of its terms are.
    real = centers.where(mask[..., None, :, None], 0.0)
    finite = torch.isfinite(outcome.reward + real.sum((-2, -1)))
    failure = outcome.failure | ~finite
    success = outcome.success & ~failure
    earned = torch.where(finite, outcome.reward, -torch.inf)
    gained, succeeded, failed = torch.zeros_like(progress.returns), progress.succeeded, progress.failed
    for step in range(centers.shape[-3]):
        counts = ~(succeeded | failed)
        gained = gained + torch.where(counts, earned[..., step], 0.0)
        succeeded = succeeded | (counts & success[..., step])
        failed = failed | (counts & failure[..., step])
    return Progress(progress.returns + gained, succeeded, failed, progress.segments + progress.active)


def judge(reward: RewardFunction, states: Tensor, mask: Tensor) -> Outcome:
    """The reward of every step of paths: `states: [..., T + 1, M, 3]` metres, `mask: [..., M]` -> fields `[..., T]`."""
    if isinstance(reward, PathReward):
        return reward.along(states, mask)
    previous, centers = states[..., :-1, :, :], states[..., 1:, :, :]
    return reward(previous, centers, mask.unsqueeze(-2).expand(centers.shape[:-1]))
