"""SeCTAR as the paper adapts it: one latent for states and actions (appendix A.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from models.state import State
from planning.backends.chunking import chunked
from planning.cavin import EffectSpace
from planning.extensions.perturbed_rollouts import RETURN_WEIGHT
from planning.extensions.sequential_halving import sequential_halving
from planning.extensions.touchdown import ObservedPoints
from planning.inputs import NoFiniteCandidateError
from planning.plan import Plan
from planning.protocol import ModelRequirements, RewardFunction, SingleLatentModel
from planning.rollouts.candidates import Candidates
from planning.rollouts.dynamics import predict_states
from planning.rollouts.ranking import best_of
from planning.searching import SearchingPlanner, summary


class SectarPlanner(SearchingPlanner):
    """Effect codes ranked by reward, as in `CavinPlanner`; g generates the pushes from the chosen code alone.

    There is no motion code to choose, so lines 8 to 10 of Algorithm 1 become a = g(s, c*). Without our additions, f
    only predicts the states after the pushes, for pictures.

    Our additions, as in `CavinPlanner`: `warm_start`, `robustness`, `idle_distance` and `touchdown_distance`. An effect
    has one motion here, so perturbed rollouts compare effect plans: of those that reach the goal, the
    `robustness.candidates` with the highest return. Their cost is the distance of the pushes' outcome to the plan's own
    first subgoal and `failure_cost` for failures, as in `CavinPlanner`, minus `RETURN_WEIGHT` times the return. Without
    the return, the pushes that move least would win, because they end closest to their own subgoals. For the same
    reason, where no plan reaches the goal, the one with the highest return is chosen, as without this addition.

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
    def plan(
        self,
        state: State,
        generators: Sequence[torch.Generator],
        previous: Plan | None = None,
        observed: ObservedPoints | None = None,
    ) -> Plan:
        """Plan for observed scenes `state: [B]`; see `CavinPlanner.plan`."""
        # Lines 5 to 7: choose the codes c* and their subgoals.
        effects = self.search_by_reward(self.space, state, generators, previous)
        here, returns = state.expand_plans(1), effects.returns
        if observed is not None and self.touchdown_distance:
            pushes = self._actions(here, effects.at(0, lambda segment: segment.rollout.code))
            returns = self.prefer_free(returns, pushes, observed)
        best = best_of(returns, "returns of effect plans")
        if self.robustness is not None:
            returns = torch.where(effects.score_state.succeeded, returns, -torch.inf)
            robust = self._most_robust(effects, returns, generators)
            best = torch.where(torch.isfinite(returns).any(-1), robust, best)
        chosen = effects.take(best.unsqueeze(-1))
        effect_codes = chosen.codes[:, 0]
        # Lines 8 to 10 without motion codes: the pushes of the first segment, which is executed.
        actions = self._actions(here, effect_codes[:, :1])
        _, path = predict_states(self.model, here, actions)
        broken = (~torch.isfinite(actions).flatten(1).all(-1)).nonzero().flatten().tolist()
        if broken:
            raise NoFiniteCandidateError(
                broken[0], "the pushes of the chosen effect are not finite; check the model's weights"
            )
        first, centers = self.idle_last(actions[:, 0], path[:, 0], state, observed)
        return Plan(
            actions=first,
            planned_actions=first,
            effect_codes=effect_codes,
            motion_codes=effect_codes.new_empty(len(actions), 0, 0),
            subgoals=chosen.states.map(lambda field: field[:, 0]),
            predicted_centers=centers,
            **summary(effects, best),
        )

    def _most_robust(self, effects: Candidates, returns: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
        """The effect plan whose first segment costs least on average, `[B]` int64; needs `robustness`.

        returns: `[B, N]`, -inf for plans that are not to be chosen.
        """
        robustness, state = self.robustness, effects.problem.state
        assert robustness is not None
        best = returns.topk(min(robustness.candidates, effects.count), -1)
        first = effects.take(best.indices)
        actions = self._actions(state.expand_plans(1), first.at(0, lambda segment: segment.rollout.code))
        scores = torch.where(torch.isfinite(actions).all(-1).all(-1), best.values, -torch.inf)
        subgoals = State(
            first.at(0, lambda segment: segment.rollout.states.centers),
            first.at(0, lambda segment: segment.rollout.states.features),
            first.plans.mask,
        )
        what = state, subgoals, scores, actions, -RETURN_WEIGHT * scores, generators
        chosen = sequential_halving(robustness, self.model, self.reward, *what, backend=self.backend)
        return best.indices.gather(1, chosen.unsqueeze(-1)).squeeze(1)
