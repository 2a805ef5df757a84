"""SeCTAR as the paper adapts it: one latent for states and actions (appendix A.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from models.state import State
from planning.backends.chunking import chunked
from planning.cavin import EffectSpace
from planning.inputs import NoFiniteCandidateError
from planning.plan import Plan
from planning.protocol import ModelRequirements, RewardFunction, SingleLatentModel
from planning.rollouts.dynamics import predict_states
from planning.rollouts.ranking import best_of
from planning.searching import SearchingPlanner, summary


class SectarPlanner(SearchingPlanner):
    """Effect codes ranked by reward, as in `CavinPlanner`; g generates the pushes from the chosen code alone.

    There is no motion code to choose, so lines 8 to 10 of Algorithm 1 become a = g(s, c*). f only predicts the states
    after the pushes, for pictures.

    model: p(c | s), h, g without motion codes, f. For the options see `CavinPlanner`. Raises ValueError for counts
    below 1, a horizon that T does not divide, and unknown names.
    """

    requires = ModelRequirements(
        "single_latent", ("effect_prior", "subgoal", "actions", "next_state"), excluded=("motion_prior",)
    )

    def __init__(self, model: SingleLatentModel, reward: RewardFunction, *positional: Any, **options: Any) -> None:
        """`options` are those of `SearchingPlanner`."""
        super().__init__(model, reward, *positional, **options)
        self.space, self._actions = EffectSpace(model), model.actions

    @chunked
    @torch.inference_mode()
    def plan(self, state: State, generators: Sequence[torch.Generator], previous: Plan | None = None) -> Plan:
        """Plan for observed scenes `state: [B]`; see `CavinPlanner.plan`."""
        # Lines 5 to 7: choose the codes c* and their subgoals.
        effects = self.search_by_reward(self.space, state, generators, previous)
        best = best_of(effects.returns, "returns of effect plans")
        chosen = effects.take(best.unsqueeze(-1))
        effect_codes = chosen.codes[:, 0]
        # Lines 8 to 10 without motion codes: the pushes of the first segment, which is executed.
        here = state.expand_plans(1)
        actions = self._actions(here, effect_codes[:, :1])
        _, path = predict_states(self.model, here, actions)
        broken = (~torch.isfinite(actions).flatten(1).all(-1)).nonzero().flatten().tolist()
        if broken:
            raise NoFiniteCandidateError(
                broken[0], "the pushes of the chosen effect are not finite; check the model's weights"
            )
        return Plan(
            actions=actions[:, 0],
            planned_actions=actions[:, 0],
            effect_codes=effect_codes,
            motion_codes=effect_codes.new_empty(len(actions), 0, 0),
            subgoals=chosen.states.map(lambda field: field[:, 0]),
            predicted_centers=path[:, 0],
            **summary(effects, best),
        )
