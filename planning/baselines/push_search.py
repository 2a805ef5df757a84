"""Flat planning: sequences of pushes, ranked by the return of the states that f predicts (the paper's baselines)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch

from models.state import State
from planning.backends.chunking import chunked
from planning.extensions.perturbed_rollouts import RETURN_WEIGHT
from planning.extensions.sequential_halving import sequential_halving
from planning.extensions.touchdown import ObservedPoints
from planning.plan import Plan
from planning.protocol import DynamicsModel, RewardFunction
from planning.rollouts.ranking import best_of, prefer
from planning.rollouts.segment import SearchSpace, actions_of
from planning.searching import SearchingPlanner, summary


class PushSearch(SearchingPlanner):
    """The common part of CVAE-MPC and MPC, everything but the source of pushes.

    space: generates the pushes of a segment, and predicts their states with f. stride_limits: metres per push, as
    published 0.01 and 0.15; None in the paper. For the other options see `CavinPlanner`.

    Samples, horizon, returns, termination and replacement, segment by segment, are Algorithm 1's.

    Our additions, as in `CavinPlanner`: `warm_start`, `robustness`, `idle_distance` and `touchdown_distance`. There is
    no subgoal, so perturbed rollouts only estimate how often the executed segment fails. The chosen sequence has the
    highest return minus `failure_cost / RETURN_WEIGHT` times the fraction of failed rollouts. By default this is 200
    times the fraction, because a failure earns -100 instead of the +100 at the goal. So the score of a sequence with
    predicted success is about its expected return. Sequences that reach the goal rank first: the rollouts of others may
    have stopped early, so their returns are not comparable, and pushes that do nothing never fail.
    """

    has_codes: ClassVar[bool] = False  # the space searches motion codes
    strides = "pushes"

    def __init__(self, space: SearchSpace, model: DynamicsModel, reward: RewardFunction, **options: Any) -> None:
        """`options`: of `SearchingPlanner`."""
        super().__init__(model, reward, **options)
        self.space = space

    @chunked
    @torch.inference_mode()
    def plan(
        self,
        state: State,
        generators: Sequence[torch.Generator],
        previous: Plan | None = None,
        observed: ObservedPoints | None = None,
    ) -> Plan:
        """Plan for observed scenes `state: [B]`; see `CavinPlanner.plan`. There are no effect codes and no subgoals."""
        candidates = self.search_by_reward(self.space, state, generators, previous)
        # A sum is finite only if all of its terms are.
        finite = torch.isfinite(candidates.actions.sum((-2, -1)))
        scores, pushes = torch.where(finite, candidates.returns, -torch.inf), candidates.at(0, actions_of)
        scores = self.prefer_free(scores, pushes, observed)
        best = best_of(scores, "returns of push sequences")
        if self.robustness is not None:
            scores = prefer(scores, candidates.score_state.succeeded)
            what = state, None, scores, pushes, -RETURN_WEIGHT * scores, generators
            best = sequential_halving(self.robustness, self.model, self.reward, *what, backend=self.backend)
        chosen = candidates.take(best.unsqueeze(-1))
        actions, path, codes = chosen.actions[:, 0], chosen.path[:, 0], chosen.codes[:, 0]
        actions, path = self.idle_last(actions, path, state, observed)
        no_codes = codes.new_empty(len(codes), 0, 0)
        return Plan(
            actions=actions[:, : self.segment_length],
            planned_actions=actions,
            effect_codes=no_codes,
            motion_codes=codes if self.has_codes else no_codes,
            subgoals=state.map(lambda field: field[:, None][:, :0]),
            predicted_centers=path,
            **summary(candidates, best),
        )
