"""Effect level: what to achieve (paper, Algorithm 1, lines 5 to 7; section 3.2, "Effect-Level Plan")."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning import ranking
from planning.candidates import Candidates
from planning.memory import remembered


class EffectPlan(NamedTuple):
    """The chosen effect codes and subgoals, and all candidates."""

    codes: Tensor  # [B, K, C] c*
    subgoals: State  # [B, K, M, .]
    segments: Tensor  # [B] int64, 1..K: segments until the plan ends
    expected_return: Tensor  # [B]
    expected_success: Tensor  # [B] bool
    noise: Tensor  # [B, K, C] of which the codes were made, or [B, 0, 0]
    candidate_centers: Tensor  # [B, N, K, M, 3] metres
    candidate_returns: Tensor  # [B, N]


def choose_effects(candidates: Candidates, chosen: Tensor | None = None) -> EffectPlan:
    """Line 7: the candidate with the highest return, and its codes and subgoals, followed back through the copies.

    `chosen`: `[B]` int64, the candidates' numbers where something else has chosen.
    Raises ValueError where no candidate of an environment has a finite return.
    """
    progress = candidates.standing
    if chosen is None:
        chosen = ranking.best(progress.returns, "returns of effect plans")
    environments = torch.arange(len(chosen), device=chosen.device)
    winner = candidates.take(chosen.unsqueeze(-1))
    return EffectPlan(
        codes=winner.history(lambda segment: segment.stretch.code)[:, 0],
        subgoals=State(
            winner.history(lambda segment: segment.stretch.states.centers)[:, 0],
            winner.history(lambda segment: segment.stretch.states.features)[:, 0],
            winner.plans.mask.expand(-1, len(winner.kept), -1),  # whoever is real stays so
        ),
        segments=progress.segments[environments, chosen],
        expected_return=progress.returns[environments, chosen],
        expected_success=progress.succeeded[environments, chosen],
        noise=remembered(winner),
        candidate_centers=candidates.history(lambda segment: segment.stretch.states.centers),
        candidate_returns=progress.returns,
    )
