"""Idle pushes last (our addition to Algorithm 1, line 11)."""

from __future__ import annotations

import torch
from torch import Tensor

from models.state import State
from planning.rollouts import returns


def idle_last(
    actions: Tensor, path: Tensor, state: State, segment_length: int, distance: float
) -> tuple[Tensor, Tensor]:
    """The same actions and states, but in the first segment idle pushes come last.

    A push is idle if f predicts that it moves no object by `distance` metres. Both groups keep their order. An idle
    push moves no object by more than `distance`, so the predictions for the other pushes stay valid up to that
    distance. A planner that plans again after every push would otherwise execute an idle push and gain nothing.

    actions: `[B, H, 4]`. path: `[B, H, M, 3]` metres. state: `[B]`, before the first push. segment_length: T.
    """
    pushes, centers = actions[:, :segment_length], path[:, :segment_length]
    moved = (centers - returns.before_each(state.centers, centers)).norm(dim=-1)
    strides = torch.where(state.mask.unsqueeze(1), moved, 0.0).amax(-1)  # [B, T]
    order = (strides < distance).int().argsort(dim=-1, stable=True)
    environments = torch.arange(len(pushes), device=pushes.device).unsqueeze(-1)
    return (
        torch.cat([pushes[environments, order], actions[:, segment_length:]], 1),
        torch.cat([centers[environments, order], path[:, segment_length:]], 1),
    )
