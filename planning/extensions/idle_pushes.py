"""Idle pushes last (our addition to Algorithm 1, line 11)."""

from __future__ import annotations

import torch
from torch import Tensor

from models.state import State
from planning.extensions.touchdown import ObservedPoints
from planning.rollouts import returns

IDLE_DISTANCE = 0.01  # metres; what moves no object by as much does nothing


def idle_last(
    actions: Tensor,
    path: Tensor,
    state: State,
    segment_length: int,
    distance: float,
    observed: ObservedPoints | None = None,
    touchdown_distance: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """The same actions, but in the first segment idle pushes come last, and the states after each of them.

    A push is idle if f predicts that it moves no object by `distance` metres. Both groups keep their order. An idle
    push moves no object by more than `distance`, so the predictions for the other pushes stay valid up to that
    distance. A planner that plans again after every push would otherwise execute an idle push and gain nothing.

    The order stays where the push that would come first touches down on an object, and the one that comes first now
    does not (`planning.extensions.touchdown`).

    actions: `[B, H, 4]`. path: `[B, H, M, 3]` metres. state: `[B]`, before the first push. segment_length: T.
    observed: points of the objects that the camera sees. touchdown_distance: metres between a push's start and these.
    """
    pushes, centers = actions[:, :segment_length], path[:, :segment_length]
    moved = (centers - returns.before_each(state.centers, centers)).norm(dim=-1)
    strides = torch.where(state.mask.unsqueeze(1), moved, 0.0).amax(-1)  # [B, T]
    idle = strides < distance
    order = idle.int().argsort(dim=-1, stable=True)
    as_given = torch.arange(segment_length, device=pushes.device)
    environments = torch.arange(len(pushes), device=pushes.device).unsqueeze(-1)
    if observed is not None and touchdown_distance and observed.points.shape[1]:
        blocked_now = observed.blocked(pushes[:, :1], touchdown_distance)
        blocked_then = observed.blocked(pushes[environments, order[:, :1]], touchdown_distance)
        order = torch.where(blocked_then & ~blocked_now, as_given, order)
    # Where the order changed, all that moves something has been pushed before the idle pushes.
    done = (order != as_given).any(-1, keepdim=True) & idle.gather(-1, order)
    after = torch.where(done[..., None, None], centers[:, -1:], centers[environments, order])
    return (
        torch.cat([pushes[environments, order], actions[:, segment_length:]], 1),
        torch.cat([after, path[:, segment_length:]], 1),
    )
