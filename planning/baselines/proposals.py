"""Proposal distributions of raw pushes: functions from standard normal noise to pushes `[..., 4]` in [-1, 1]."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from models.state import State

SPREAD = math.pi / 4  # radians; largest difference from the segment's angle, either way
JITTER = 0.3  # on each normalised motion component
ASIDE = 0.03  # metres between a push's path and the object's centre, at most
BEFORE = (0.05, 0.12)  # metres between a push's start and the object's centre


class Proposal(Protocol):
    """A distribution of pushes, as a function of N(0, I)."""

    shared: int  # numbers of noise that all pushes of a segment share
    own: int  # numbers of noise of each push

    def __call__(self, state: State, shared: Tensor, own: Tensor) -> Tensor:
        """One push in `state: [...]`, from `shared: [..., shared]` and `own: [..., own]` -> `[..., 4]` in [-1, 1]."""


class UniformPushes:
    """Uniform over the action space (MPC of the paper, section 4.1: "the original action space")."""

    shared, own = 0, 4

    def __call__(self, state: State, shared: Tensor, own: Tensor) -> Tensor:
        """See `Proposal`; the state is not read."""
        return _uniform(own)


@dataclass(frozen=True)
class PushBox:
    """The scale of normalised pushes: starts span the box from `low` to `high`, motions up to `motion`, in metres."""

    low: tuple[float, float]
    high: tuple[float, float]
    motion: float


class HeuristicPushes:
    """Pushes that are likely to move something, as the data-collecting policy makes them, without its rejections.

    A segment has one object and one angle. Each push starts 5 to 12 cm before the object's (predicted) centre, at most
    3 cm aside, and goes towards it, rotated by up to 45 degrees, with noise of 0.3 on the motion. Starts are clipped to
    the box; f has to predict the failure of starts on other objects. Not in the paper, whose MPC samples uniformly.
    """

    shared, own = 2, 5

    def __init__(self, box: PushBox) -> None:
        self.box = box

    def __call__(self, state: State, shared: Tensor, own: Tensor) -> Tensor:
        """See `Proposal`."""
        centers = state.centers
        real = state.mask.sum(-1, keepdim=True)  # [..., 1]
        rank = (torch.special.ndtr(shared[..., :1]) * real).long().clamp(max=(real - 1).clamp(min=0))
        index = ((state.mask.cumsum(-1) > rank) & state.mask).int().argmax(-1, keepdim=True)
        target = centers.gather(-2, index.unsqueeze(-1).expand(*index.shape, 3)).squeeze(-2)[..., :2]
        turn, aside, before = _uniform(own[..., 0]), _uniform(own[..., 1]), torch.special.ndtr(own[..., 2])
        angle = math.pi * _uniform(shared[..., 1]) + SPREAD * turn
        direction = torch.stack([angle.cos(), angle.sin()], -1)
        normal = torch.stack([-direction[..., 1], direction[..., 0]], -1)
        distance = BEFORE[0] + (BEFORE[1] - BEFORE[0]) * before
        start = target - distance.unsqueeze(-1) * direction + ASIDE * aside.unsqueeze(-1) * normal
        low, high = (
            torch.cat([start.new_full((1,), one) for one in corner]) for corner in (self.box.low, self.box.high)
        )
        motion = (direction + JITTER * _uniform(own[..., 3:5])).clamp(-1.0, 1.0)
        return torch.cat([(2.0 * (start - low) / (high - low) - 1.0).clamp(-1.0, 1.0), motion], -1)


def _uniform(noise: Tensor) -> Tensor:
    return 2.0 * torch.special.ndtr(noise) - 1.0
