"""Pushes that move nothing (our addition to Algorithm 1, line 10)."""

from __future__ import annotations

import torch

from models.state import State
from planning import returns
from planning.motions import MotionPlan


def idle_last(motions: MotionPlan, state: State, segment_length: int, distance: float) -> MotionPlan:
    """The same pushes, but in the first segment those last that f predicts to move no object by `distance` metres.

    state: `[B]`, before the first push. segment_length: T. Both parts keep their order. Where an idle push was left
    out nothing moved by more than `distance`, so what was predicted after the others holds as far.

    Whoever plans anew after every push would otherwise make an idle one, be where he was, and may choose another.
    """
    pushes, path = motions.actions[:, :segment_length], motions.predicted_centers[:, :segment_length]
    moved = (path - returns.before_each(state.centers, path)).norm(dim=-1)
    strides = torch.where(state.mask.unsqueeze(1), moved, 0.0).amax(-1)  # [B, T]
    order = (strides < distance).int().argsort(dim=-1, stable=True)
    environments = torch.arange(len(pushes), device=pushes.device).unsqueeze(-1)
    return motions._replace(
        actions=torch.cat([pushes[environments, order], motions.actions[:, segment_length:]], 1),
        predicted_centers=torch.cat([path[environments, order], motions.predicted_centers[:, segment_length:]], 1),
    )
