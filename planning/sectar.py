"""SeCTAR as the paper adapts it: one latent for states and actions (appendix A.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from models.state import State
from planning.bulk import in_bulk
from planning.effects import choose_effects
from planning.following import follow
from planning.inputs import HopelessEnvironmentError
from planning.levels import EffectLevel
from planning.plan import Plan
from planning.searching import SearchingPlanner


class SectarPlanner(SearchingPlanner):
    """Effect codes ranked by reward, as in `CavinPlanner`; the pushes are what g makes of the chosen code alone.

    There is no motion code to choose, so lines 8 to 10 of Algorithm 1 come down to a = g(s, c*). f is asked only
    where the pushes lead, for drawing.

    model: p(c | s), h, g without motion codes, f. For the options see `CavinPlanner`. Raises ValueError for counts
    below 1, a horizon that T does not divide, and unknown names.
    """

    needs = ("effect_prior", "subgoal", "actions", "next_state")
    lacks = ("motion_prior",)
    usual_model = "single_latent"

    @in_bulk
    @torch.inference_mode()
    def plan(self, state: State, generators: Sequence[torch.Generator], previous: Plan | None = None) -> Plan:
        """Plan for observed scenes `state: [B]`; see `CavinPlanner.plan`."""
        # Lines 5 to 7: choose the codes c* and their subgoals.
        effects = choose_effects(self.search(EffectLevel(self.model), state, generators, previous))
        # Lines 8 to 10 without motion codes: the pushes of the first segment, all that is executed.
        here = state.expand_plans(1)
        generate: Any = self.model.actions  # of a model whose g reads no motion code
        actions = generate(here, effects.codes[:, :1])
        _, path = follow(self.model, here, actions)
        broken = (~torch.isfinite(actions).flatten(1).all(-1)).nonzero().flatten().tolist()
        if broken:
            raise HopelessEnvironmentError(
                broken[0], "the pushes of the chosen effect are not finite; check the model's weights"
            )
        return Plan(
            actions=actions[:, 0],
            planned_actions=actions[:, 0],
            effect_codes=effects.codes,
            motion_codes=effects.codes.new_empty(len(actions), 0, 0),
            subgoals=effects.subgoals,
            segments=effects.segments,
            predicted_centers=path[:, 0],
            expected_return=effects.expected_return,
            expected_success=effects.expected_success,
            candidate_centers=effects.candidate_centers,
            noise=effects.noise,
            candidate_returns=effects.candidate_returns,
        )
