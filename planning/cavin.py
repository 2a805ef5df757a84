"""Algorithm 1 of the paper: hierarchical planning with cascaded generative processes (section 3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Generator, Tensor

from cavin_pyro.models.checks import check_choice, check_number
from cavin_pyro.models.state import State
from cavin_pyro.planning.additions import HOOKS, Choice, ChosenEffect
from cavin_pyro.planning.focus import Focus
from cavin_pyro.planning.optimizers import Optimizer, make_optimizer
from cavin_pyro.planning.protocol import EffectModel, ModelRequirements, Plan, PlanningModel, Query, SegmentRollout
from cavin_pyro.planning.returns import SubgoalDistance, TrackingCost, best_of, interpolate, select_segment
from cavin_pyro.planning.rollout import actions_of, predict_states, project
from cavin_pyro.planning.sampling import sample_codes
from cavin_pyro.planning.searching import SearchingPlanner, summary


class CavinPlanner(SearchingPlanner):
    """First *what* to achieve (effect codes, ranked by reward), then *how* (motion codes, ranked by tracking cost).

    The defaults are the paper's, `planner=paper`; `planner=cavin` has our additions.
    motion_share: motions to sample at line 8, as a share of N (paper: 1).
    motion_optimizer: searches motion codes instead of `optimizer`; None takes the same.
    motion_horizon: motions are planned for all K segments, `full_horizon` (paper), or for the executed `first_segment`.
    feature_weight: of squared feature distances to subgoals; 0 (paper): centres only; null: by the scales of the space.
    options: of `cavin_pyro.planning.searching.SearchingPlanner`, whose optimizer searches codes at both levels.
    Raises ValueError for counts below 1, a horizon that T does not divide, unknown names, and a negative weight.
    """

    requires = ModelRequirements("cascaded", ("effect_prior", "motion_prior", "subgoal", "actions", "next_state"))
    hooks = HOOKS

    def __init__(
        self,
        model: PlanningModel,
        samples: int = 1024,
        horizon: int = 30,
        motion_horizon: str = "full_horizon",
        *,
        motion_share: float = 1.0,
        motion_optimizer: str | Optimizer | None = None,
        feature_weight: float | None = 0.0,
        **options: Any,
    ) -> None:
        super().__init__(model, samples, horizon, **options)
        self.model: PlanningModel = model
        check_choice("motion_horizon", motion_horizon, ("full_horizon", "first_segment"))
        self.feature_weight = feature_weight or 0.0
        check_number("feature_weight", self.feature_weight)
        check_number("motion_share", motion_share, high=1, positive=True)
        self.motion_samples = max(1, int(motion_share * samples))
        self.motion_optimizer = make_optimizer(
            motion_optimizer or self.optimizer, samples=self.motion_samples, argument="motion_optimizer"
        )
        self.whole_horizon = motion_horizon == "full_horizon"

    def plan_scene(self, scene: Query) -> Plan:
        """Algorithm 1 for observed scenes `scene.state: [B]`."""
        # Line 1, K = H / T, is in the constructor; lines 2, 3 and 12 are the caller's. Line 4: s_t.
        s_t, focus = scene.state, self.added("focus", Focus(), scene)

        # Lines 5 and 6: sample N sequences of effect codes c_{1:K}, predict their subgoals and interpolate.
        effect_space = EffectSpace(self.model, scene.reward.reads_features)
        effects = self.search_by_reward(effect_space, scene._replace(state=focus.of(s_t)))

        # Line 7: choose c* and its subgoals, with the highest cumulative reward.
        i = best_of(effects.returns, "returns of effect plans")
        chosen = effects.take(i.unsqueeze(-1))
        c_star, subgoals = chosen.codes[:, 0], focus.among(s_t, chosen.states.map(lambda field: field[:, 0]))
        effect = ChosenEffect(subgoals, chosen.progress.segments[:, 0], chosen.progress.succeeded[:, 0])

        # Lines 8 and 9: sample N sequences of motion codes z_{1:K}, predict their actions and states with c*.
        T, N, K = self.segment_length, self.motion_samples, scene.segments if self.whole_horizon else 1
        distance = self.added("subgoal_distance", SubgoalDistance(self.feature_weight), scene, K)
        tracking_cost = self.added("wrap_objective", TrackingCost(subgoals, effect.segments, distance), scene, effect)
        space = MotionSpace(self.model, c_star, focus, self.decimals, scene.reward.reads_features)
        motions = self.search(space, tracking_cost, scene, optimizer=self.motion_optimizer, segments=K, samples=N)

        # Line 10: choose z* and its actions a*, which lead to the states closest to the subgoals.
        choice = Choice(scene, self.model, motions, lambda: motions.at(0, actions_of), effect, distance)
        j = best_of(self.added("rank", motions.returns, choice), "distances of motion plans to the subgoals")
        best = motions.take(j.unsqueeze(-1))
        z_star, a_star, path = best.codes[:, 0], best.actions[:, 0], best.path[:, 0]

        # Line 11: the caller executes the first T actions, or the first of them.
        return Plan(a_star[:, :T], a_star, c_star, z_star, subgoals, predicted_centers=path, **summary(effects, i))


class EffectSpace(NamedTuple):
    """Lines 5 and 6: effect codes, and the subgoals that h predicts from them."""

    model: EffectModel
    features: bool = False  # whether paths record these too

    @property
    def dimension(self) -> int:
        """C."""
        return self.model.effect_dimension

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[Generator]
    ) -> SegmentRollout:
        # Line 5: sample c_k, a segment at a time, since a learned prior p(c | s) depends on the state before it.
        c = sample_codes(self.model.effect_prior, [plans], noise, generators)
        # Line 6: predict the subgoal by equation 2, and interpolate the state trajectory.
        subgoal = self.model.subgoal(here, c).expand(plans.batch_shape)
        path = interpolate(plans.values(self.features), subgoal.values(self.features), self.model.segment_length)
        return SegmentRollout(c, None, subgoal, path)


class MotionSpace(NamedTuple):
    """Lines 8 and 9: motion codes, the actions that g generates from them, and the states that f predicts."""

    model: PlanningModel
    effect_codes: Tensor  # [B, K, C] c*, with which every sequence is paired
    focus: Focus
    decimals: int | None
    features: bool = False

    @property
    def dimension(self) -> int:
        """Z."""
        return self.model.motion_dimension

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[Generator]
    ) -> SegmentRollout:
        c = select_segment(self.effect_codes, segment).expand(-1, plans.batch_shape[-1], -1)
        # Line 8: sample z_k, a segment at a time, as in line 5.
        z = sample_codes(self.model.motion_prior, [self.focus.of(plans), c], noise, generators)
        # Line 9: generate T actions by equation 3, and predict a state after each by equation 1.
        a = project(self.model.actions(self.focus.of(here), c, z), self.decimals)
        states, path = predict_states(self.model, here, a, self.features)
        return SegmentRollout(z, a, states, path)
