"""Another effect where no motion moves anything (our addition to Algorithm 1, between lines 10 and 7).

For example because an obstacle occupies the place from which to push the target.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from cavin_pyro.models.checks import check_number
from cavin_pyro.models.state import State
from cavin_pyro.planning import records
from cavin_pyro.planning.additions.addition import Addition
from cavin_pyro.planning.protocol import Plan, Query
from cavin_pyro.planning.returns import best_of
from cavin_pyro.planning.rollout import Candidates

STILL = 0.01  # metres; what moves no object by as much does nothing
EFFECT = 0.02  # metres; an effect that moves an object farther needs a motion that moves something
SIMILAR = 0.5  # cosine of the angle between the moves of two effects, all objects together


@dataclass(frozen=True)
class EffectRetries(Addition):
    """Tries another effect, up to `retries` times, where no motion moves anything.

    The search for the best effect may have stopped early; the other ones are then rolled out to their ends. Raises
    ValueError for a number below 1.
    """

    retries: int = 3

    def __post_init__(self) -> None:
        check_number("retries", self.retries, 1, whole=True)

    def revise(
        self, plan: Plan, *, scene: Query, effects: Candidates, chosen: Tensor, plan_motions: Callable[..., Plan]
    ) -> Plan:
        scores = effects.returns
        for number in range(self.retries):
            after = plan.predicted_centers[:, plan.actions.shape[1] - 1]
            stuck = is_unmoved(scene.state, plan.subgoals.centers[:, 0], after)
            if not stuck.any():
                break
            if number == 0:
                effects = effects.rolled_out()
                scores = effects.returns
            scores = leave_out_similar(scores, first_moves(effects), chosen, stuck)
            chosen = best_of(scores, "returns of effect plans")
            before = [generator.get_state() for generator in scene.generators]
            plan = records.where(stuck, plan_motions(effects, chosen), plan)
            for generator, own, tried in zip(scene.generators, before, stuck.tolist(), strict=True):
                if not tried:  # an environment's plan depends on its own arguments only
                    generator.set_state(own)
        return plan


def is_unmoved(state: State, subgoals: Tensor, predicted: Tensor) -> Tensor:
    """Where the chosen motion moves nothing, and the chosen effect should: `[B]` bool.

    Args:
        state: `[B]`. subgoals: `[B, M, 3]` metres, the first ones. predicted: `[B, M, 3]` metres, by f after T pushes.
    """
    return (_farthest(state, predicted) < STILL) & (_farthest(state, subgoals) >= EFFECT)


def first_moves(effects: Candidates) -> Tensor:
    """How the first effect of `effects: [B, N]` moves each object that they are about: `[B, N, m, 2]` metres."""
    state = effects.problem.state
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
