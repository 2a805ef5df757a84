"""Flat planning: sequences of pushes, ranked by the return of the states that f predicts (the paper's baselines)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch

from models.state import State
from planning.backends.chunking import chunked
from planning.plan import Plan
from planning.protocol import DynamicsModel, RewardFunction
from planning.rollouts.ranking import best_of
from planning.rollouts.segment import SearchSpace
from planning.searching import SearchingPlanner, summary


class PushSearch(SearchingPlanner):
    """The common part of CVAE-MPC and MPC, everything but the source of pushes.

    space: generates the pushes of a segment, and predicts their states with f. stride_limits: metres per push, as
    published 0.01 and 0.15; None in the paper. For the other options see `CavinPlanner`.

    Samples, horizon, returns, termination and replacement, segment by segment, are Algorithm 1's.
    """

    has_codes: ClassVar[bool] = False  # the space searches motion codes
    strides = "pushes"

    def __init__(self, space: SearchSpace, model: DynamicsModel, reward: RewardFunction, **options: Any) -> None:
        """`options`: of `SearchingPlanner`."""
        super().__init__(model, reward, **options)
        self.space = space

    @chunked
    @torch.inference_mode()
    def plan(self, state: State, generators: Sequence[torch.Generator], previous: Plan | None = None) -> Plan:
        """Plan for observed scenes `state: [B]`; see `CavinPlanner.plan`. There are no effect codes and no subgoals."""
        candidates = self.search_by_reward(self.space, state, generators, previous)
        # A sum is finite only if all of its terms are.
        finite = torch.isfinite(candidates.actions.sum((-2, -1)))
        best = best_of(torch.where(finite, candidates.returns, -torch.inf), "returns of push sequences")
        chosen = candidates.take(best.unsqueeze(-1))
        actions, codes = chosen.actions[:, 0], chosen.codes[:, 0]
        no_codes = codes.new_empty(len(codes), 0, 0)
        return Plan(
            actions=actions[:, : self.segment_length],
            planned_actions=actions,
            effect_codes=no_codes,
            motion_codes=codes if self.has_codes else no_codes,
            subgoals=state.map(lambda field: field[:, None][:, :0]),
            predicted_centers=chosen.path[:, 0],
            **summary(candidates, best),
        )
