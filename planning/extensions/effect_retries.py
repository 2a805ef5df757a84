"""Another effect where no motion moves anything (our addition to Algorithm 1, between lines 10 and 7).

Line 7 chooses an effect without knowing whether a motion brings it about. Where an obstacle takes the place from which
the target would have to be pushed, f lets every motion without a failure move nothing, and the next plan chooses the
same effect again.
"""

from __future__ import annotations

import torch
from torch import Tensor

from models.state import State
from planning.rollouts.candidates import Candidates

UNMOVED = 0.01  # metres; a motion that moves no object so far does nothing
EFFECT = 0.02  # metres; an effect that moves an object so far asks for a motion
SIMILAR = 0.5  # cosine of the angle between the moves of two effects, all objects together


def is_unmoved(state: State, subgoals: Tensor, predicted: Tensor) -> Tensor:
    """Where the chosen motion moves nothing, and the chosen effect should: `[B]` bool.

    Args:
        state: `[B]`. subgoals: `[B, M, 3]` metres, the first ones. predicted: `[B, M, 3]` metres, by f after T pushes.
    """
    return (_farthest(state, predicted) < UNMOVED) & (_farthest(state, subgoals) >= EFFECT)


def first_moves(state: State, effects: Candidates) -> Tensor:
    """How the first effect of `effects: [B, N]` moves each object of `state: [B]`: `[B, N, M, 2]` metres."""
    ends = effects.at(0, lambda record: record.rollout.states.centers)
    moves = (ends - state.centers.unsqueeze(1))[..., :2]
    return torch.where(state.mask[:, None, :, None], moves, 0.0)


def leave_out_similar(scores: Tensor, moves: Tensor, chosen: Tensor, where: Tensor) -> Tensor:
    """Scores `[B, N]` that leave out candidates whose first effect is like the chosen one, or none at all.

    Where nothing would be left, and outside of `where: [B]` bool, the scores stay as they are.

    Args:
        moves: `[B, N, M, 2]` metres, see `first_moves`. chosen: `[B]` int64, candidates.
    """
    flat = moves.flatten(-2)  # [B, N, 2 M]
    environments = torch.arange(len(chosen), device=chosen.device)
    length = flat.norm(dim=-1)
    one = flat[environments, chosen].unsqueeze(-2)
    cosine = (flat * one).sum(-1) / (length * one.norm(dim=-1)).clamp_min(1e-9)
    other = (cosine < SIMILAR) & (moves.norm(dim=-1).amax(-1) >= EFFECT) & torch.isfinite(scores)
    usable = (where & other.any(-1)).unsqueeze(-1)
    return torch.where(usable & ~other, -torch.inf, scores)


def _farthest(state: State, centers: Tensor) -> Tensor:
    """How far the object that moves farthest would move on the table: `[B]` metres."""
    away = (centers - state.centers)[..., :2].norm(dim=-1)
    return torch.where(state.mask, away, 0.0).amax(-1)
