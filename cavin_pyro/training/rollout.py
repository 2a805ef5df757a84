"""The error of f's multi-step rollouts, as in planning: a term of the objective beside the bound.

The bound scores each push from the state that was observed before it. A plan's later pushes start from predictions,
whose errors grow, and the bound does not penalise these.
"""

from __future__ import annotations

import torch
from torch import Tensor

from models.model import Model
from models.state import State, Window

CENTER_UNIT = 0.005  # metres, a typical error of f after one push
FEATURE_UNIT = 0.1  # of a vector of unit length
SMOOTHING = 1e-6  # square metres, and of feature vectors; the distance has no gradient at 0


def rollout_loss(model: Model, window: Window) -> Tensor:
    """Distances between f's own rollout and what was observed, summed over the windows `[B]`, a scalar.

    s^_0 = s_0, s^_t+1 = mean of f(. | s^_t, a_t) for t = 0, ..., T - 1, and the term is the sum over t and objects of
    |center^ - center| / 5 mm + |feature^ - feature| / 0.1. Distances, not squares, because a few pushes end with an
    object that rolls away. Objects count that are real before and after push t, in windows whose pushes up to t all
    count (`transition_mask`).
    """
    state, counts = window.first, torch.ones_like(window.sequence_mask)
    loss = window.actions.new_zeros(())
    for step in range(window.segment_length):
        state = model.next_state(state, window.actions[..., step, :])
        before, after = window.states.step(step), window.states.step(step + 1)
        counts = counts & window.transition_mask[..., step]
        far = distance_in_units(state, after)
        loss = loss + far.where(before.mask & after.mask & counts.unsqueeze(-1), 0.0).sum()
    return loss


def distance_in_units(one: State, other: State) -> Tensor:
    """|center - center| / 5 mm + |feature - feature| / 0.1 of each object: `[..., M]`."""
    far = _distance(one.centers, other.centers) / CENTER_UNIT
    return far + _distance(one.features, other.features) / FEATURE_UNIT


def _distance(one: Tensor, other: Tensor) -> Tensor:
    return ((one - other).square().sum(-1) + SMOOTHING).sqrt()
