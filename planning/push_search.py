"""Planning in one level: sequences of pushes, ranked by the reward of what f predicts (the paper's flat baselines)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from models.state import State
from planning import ranking
from planning.bulk import in_bulk
from planning.candidates import Candidates
from planning.memory import remembered
from planning.plan import Plan
from planning.protocol import PlanningModel, RewardFunction
from planning.searching import SearchingPlanner
from planning.segments import Level, pushes_of


class PushSearch(SearchingPlanner):
    """What CVAE-MPC and MPC share: everything but where pushes come from.

    level: makes the pushes of a segment, and predicts them with f. stride_limits: metres per push, as published
    0.01 and 0.15; None in the paper. For the other options see `CavinPlanner`.

    Samples, horizon, returns, ends of plans and replacement of dead plans, segment by segment, are Algorithm 1's.
    """

    has_codes = False  # whether what is searched are motion codes

    strides = "pushes"

    def __init__(self, level: Level, model: PlanningModel, reward: RewardFunction, **options: Any) -> None:
        """`options`: of `SearchingPlanner`."""
        super().__init__(model, reward, **options)
        self.level = level

    @in_bulk
    @torch.inference_mode()
    def plan(self, state: State, generators: Sequence[torch.Generator], previous: Plan | None = None) -> Plan:
        """Plan for observed scenes `state: [B]`; see `CavinPlanner.plan`. There are no effect codes and no subgoals."""
        return self._best(self.search(self.level, state, generators, previous))

    def _best(self, candidates: Candidates) -> Plan:
        progress = candidates.standing
        # A sum is finite only where everything in it is.
        sound = torch.isfinite(candidates.history(pushes_of).sum((-3, -2, -1)))
        scores = torch.where(sound, progress.returns, -torch.inf)
        chosen = ranking.best(scores, "returns of push sequences")
        environments = torch.arange(len(chosen), device=chosen.device)
        winner = candidates.take(chosen.unsqueeze(-1))
        actions = winner.history(pushes_of)[:, 0].flatten(1, 2)
        state = candidates.search.state
        codes = winner.history(lambda segment: segment.stretch.code)[:, 0]
        nothing = codes.new_empty(len(codes), 0, 0)
        return Plan(
            actions=actions[:, : self.model.segment_length],
            planned_actions=actions,
            effect_codes=nothing,
            motion_codes=codes if self.has_codes else nothing,
            subgoals=state.map(lambda field: field[:, None][:, :0]),
            segments=progress.segments[environments, chosen],
            predicted_centers=winner.history(lambda segment: segment.stretch.path)[:, 0].flatten(1, 2),
            expected_return=progress.returns[environments, chosen],
            expected_success=progress.succeeded[environments, chosen],
            candidate_centers=candidates.history(lambda segment: segment.stretch.states.centers),
            noise=remembered(winner),
            candidate_returns=progress.returns,
        )
