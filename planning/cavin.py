"""Algorithm 1 of the paper: hierarchical planning with cascaded generative processes (section 3.2)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning.additions.effect_retries import try_other_effects
from cavin_pyro.planning.additions.failure_avoidance import AvoidFailures, prefer_no_failure
from cavin_pyro.planning.additions.guidance import guided_tracking
from cavin_pyro.planning.additions.nearest_objects import NearestObjects, nearest_objects
from cavin_pyro.planning.additions.perturbed_rollouts import PerturbedRollouts, most_robust
from cavin_pyro.planning.additions.touchdown import ObservedPoints
from cavin_pyro.planning.checks import check_choice, check_positive, check_weight
from cavin_pyro.planning.optimizers import Optimizer, make_optimizer
from cavin_pyro.planning.protocol import (
    EffectModel,
    ModelRequirements,
    Objective,
    Plan,
    PlanningModel,
    RewardFunction,
    SegmentRollout,
    goal_objects,
)
from cavin_pyro.planning.returns import AUTO, END, FIRST_PUSH, SubgoalDistance, best_of, interpolate
from cavin_pyro.planning.rollout import Candidates, actions_of, predict_states, select_segment
from cavin_pyro.planning.sampling import sample_codes
from cavin_pyro.planning.searching import SearchingPlanner, chunked, summary

MOTION_HORIZONS = ("full_horizon", "first_segment")
# Motions are all sampled for one effect, so few candidates suffice.
FEW_CANDIDATES = PerturbedRollouts(candidates=64, rounds=2, reduction_factor=8)
TRACKING = (AUTO, END, FIRST_PUSH)


class CavinPlanner(SearchingPlanner):
    """First *what* to achieve (effect codes, ranked by reward), then *how* (motion codes, ranked by tracking cost).

    Without options this is `planner=cavin`, with our additions; `planner=paper` names the options of the paper.

    model: h, g, f and their priors.
    reward: the task.
    samples: N, at line 5, and in the paper also at line 8.
    motion_samples: how many motions to sample at line 8: N in the paper; None takes half of N, and 1 leaves nothing to
        choose at line 10.
    motion_optimizer: searches motion codes instead of `optimizer`; None takes the same.
    motion_horizon: `full_horizon` plans motions for all K segments and compares them with all K subgoals (paper);
        `first_segment` plans and compares only the executed segment (published implementation).
    feature_weight: square metres per squared unit of feature distance, in "closest to the subgoals"; 0 compares
        centres only.
    tracking_at: our addition to line 10: which predicted state is compared with a subgoal: `end`, after the T pushes of
        a segment (paper), or `first_push`, for callers that plan again after each push; `auto` is `first_push` where
        the goal is about all objects and motions are of one segment, else `end`: with `first_push` the target breaks
        rules more often. Commands replace `auto` by `end` unless `pushes_per_plan=1`.
    nearest_objects: our addition to line 5: where the goal is about the target, plans are about it and the objects
        nearest to it, this many in all; None plans for all objects (paper).
    effect_retries: our addition to line 7: how often another effect is tried where no motion moves anything; 0 in the
        paper.
    avoid_failures: our addition to line 10: prefers motions along which f predicts no failure; false in the paper.
    robustness: our addition to line 10: ranks the best motions by perturbed rollouts; None in the paper.
    options: of `cavin_pyro.planning.searching.SearchingPlanner`, whose optimizer searches codes at both levels.

    Raises ValueError for counts below 1, a horizon that T does not divide, an unknown `motion_horizon`, `optimizer`,
    `reward_at` or `tracking_at`, limits out of order, and a weight or a distance that is negative or not finite.
    """

    requires = ModelRequirements("cascaded", ("effect_prior", "motion_prior", "subgoal", "actions", "next_state"))

    def __init__(
        self,
        model: PlanningModel,
        reward: RewardFunction,
        samples: int = 1024,
        horizon: int = 30,
        motion_horizon: str = "first_segment",
        *,
        motion_samples: int | None = None,
        motion_optimizer: str | Optimizer | None = None,
        feature_weight: float = 0.0,
        tracking_at: str = AUTO,
        nearest_objects: int | None = 2,
        effect_retries: int = 3,
        avoid_failures: bool = True,
        robustness: PerturbedRollouts | None = FEW_CANDIDATES,
        **options: Any,
    ) -> None:
        super().__init__(model, reward, samples, horizon, robustness=robustness, **options)
        self.model: PlanningModel = model
        if motion_horizon not in MOTION_HORIZONS:
            raise ValueError(f"unknown motion_horizon '{motion_horizon}': choose {' or '.join(MOTION_HORIZONS)}")
        check_weight("feature_weight", feature_weight)
        check_choice("tracking_at", tracking_at, TRACKING)
        self.motion_samples = max(1, samples // 2) if motion_samples is None else motion_samples
        check_positive("motion_samples", self.motion_samples)
        self.motion_optimizer = make_optimizer(
            motion_optimizer or self.optimizer, samples=self.motion_samples, argument="motion_optimizer"
        )
        self.motion_segments = self.segments if motion_horizon == "full_horizon" else 1
        self.feature_weight, self.tracking_at = feature_weight, tracking_at
        if nearest_objects is not None:
            check_positive("nearest_objects", nearest_objects)
        self.nearest_objects = nearest_objects
        if effect_retries < 0:
            raise ValueError(f"effect_retries must be 0 or more, not {effect_retries}")
        self.effect_retries = effect_retries
        self.avoid_failures = avoid_failures

    @property
    def distance(self) -> SubgoalDistance:
        """To the subgoal, in this episode."""
        at = self.tracking_at
        if at == AUTO:
            alone = self.motion_segments == 1 and goal_objects(self.reward) == "all"
            at = FIRST_PUSH if alone else END
        return SubgoalDistance(self.feature_weight, at)

    @chunked
    @torch.inference_mode()
    def plan(
        self,
        state: State,
        generators: Sequence[torch.Generator],
        observed: ObservedPoints | None = None,
    ) -> Plan:
        """Algorithm 1 for observed scenes `state: [B]`; the call advances `generators`, one per environment.

        `observed`: points of the objects that the camera sees, where no push may touch down. An environment's plan
        depends on its own arguments only. For errors see `cavin_pyro.planning.searching.chunked`.
        """
        # Line 1 (K = H / T) is in the constructor. Lines 2, 3 and 12, the loop over t, are the caller's.
        # Line 4: receive the new s_t from the environment.
        s_t = state
        near = nearest_objects(s_t, self.nearest_objects, self.reward)

        # Lines 5 and 6: sample N sequences of effect codes c_{1:K}, predict their subgoals and interpolate.
        effects = self.search_by_reward(EffectSpace(self.model), near.of(s_t), generators)

        # Line 7: choose c* and its subgoals, with the highest cumulative reward.
        i = best_of(effects.returns, "returns of effect plans")
        # Our addition: lines 7 to 11 again where no motion moves anything.
        motions_for = partial(self._plan_motions, s_t, near, generators, observed)
        return try_other_effects(self.effect_retries, motions_for, i, near.of(s_t), effects, s_t, generators)

    def _plan_motions(
        self,
        s_t: State,
        near: NearestObjects,
        generators: Sequence[torch.Generator],
        observed: ObservedPoints | None,
        effects: Candidates,
        i: Tensor,
    ) -> Plan:
        """Lines 8 to 11 for the effect plans `i: [B]` int64 among `effects: [B, N]`."""
        reward, T = self.reward, self.segment_length
        chosen = effects.take(i.unsqueeze(-1))
        c_star, subgoals = chosen.codes[:, 0], near.among(s_t, chosen.states.map(lambda field: field[:, 0]))

        # Lines 8 and 9: sample N sequences of motion codes z_{1:K}, predict their actions and states with c*.
        ends = effects.score_state.segments.take_along_dim(i.unsqueeze(-1), 1)[:, 0]
        tracking_cost: Objective = TrackingCost(subgoals, ends, self.distance)
        reached = effects.score_state.succeeded.take_along_dim(i.unsqueeze(-1), 1)[:, 0]
        tracking_cost = guided_tracking(tracking_cost, self.distance_to_goal, reached)
        if self.avoid_failures:
            tracking_cost = AvoidFailures(tracking_cost, ends, reward)
        motions = self.search(
            MotionSpace(self.model, c_star, near),
            tracking_cost,
            s_t,
            generators,
            optimizer=self.motion_optimizer,
            segments=self.motion_segments,
            samples=self.motion_samples,
        )

        # Line 10: choose z* and its actions a*, which lead to the states closest to the subgoals.
        tracking, scores = motions.score_state, motions.returns
        if self.avoid_failures:
            tracking, scores = prefer_no_failure(motions.score_state)
        scores = self.prefer_free(scores, motions.at(0, actions_of), observed)
        j = best_of(scores, "distances of motion plans to the subgoals")
        if self.robustness is not None:
            later_cost = tracking.cost - tracking.executed_cost
            task = self.model, reward, subgoals, self.distance
            j = most_robust(self.robustness, motions, scores, later_cost, *task)
        chosen = motions.take(j.unsqueeze(-1))
        z_star, a_star, path = chosen.codes[:, 0], chosen.actions[:, 0], chosen.path[:, 0]

        # Line 11: the caller executes the first T actions, or the first of them.
        return Plan(
            actions=a_star[:, :T],
            planned_actions=a_star,
            effect_codes=c_star,
            motion_codes=z_star,
            subgoals=subgoals,
            predicted_centers=path,
            **summary(effects, i),
        )


class EffectSpace(NamedTuple):
    """Lines 5 and 6: effect codes, and the subgoals that h predicts from them."""

    model: EffectModel

    @property
    def dimension(self) -> int:
        """C."""
        return self.model.effect_dimension

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        """See `cavin_pyro.planning.protocol.SearchSpace`."""
        # Line 5: sample c_k, a segment at a time, since a learned prior p(c | s) depends on the state before it.
        c = sample_codes(self.model.effect_prior, [plans], noise, generators)
        # Line 6: predict the subgoal by equation 2 ...
        subgoal = self.model.subgoal(here, c).expand(plans.batch_shape)
        # ... and interpolate the state trajectory.
        path = interpolate(plans.centers, subgoal.centers, self.model.segment_length)
        return SegmentRollout(c, None, subgoal, path)


class MotionSpace(NamedTuple):
    """Lines 8 and 9: motion codes, the actions that g generates from them, and the states that f predicts."""

    model: PlanningModel
    effect_codes: Tensor  # [B, K, C] c*, with which every sequence is paired
    near: NearestObjects  # the objects that they are about

    @property
    def dimension(self) -> int:
        """Z."""
        return self.model.motion_dimension

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        """See `cavin_pyro.planning.protocol.SearchSpace`."""
        c = select_segment(self.effect_codes, segment).expand(-1, plans.batch_shape[-1], -1)
        # Line 8: sample z_k, a segment at a time, as in line 5.
        z = sample_codes(self.model.motion_prior, [self.near.of(plans), c], noise, generators)
        # Line 9: generate T actions by equation 3, and predict a state after each by equation 1.
        a = self.model.actions(self.near.of(here), c, z)
        states, path = predict_states(self.model, here, a)
        return SegmentRollout(z, a, states, path)


class TrackingState(NamedTuple):
    """The tracking cost of motion candidates so far; fields `[B, n]`."""

    cost: Tensor  # square metres, summed over the segments
    executed_cost: Tensor  # of the first segment, which is executed
    finite: Tensor  # bool: all actions are finite

    @property
    def returns(self) -> Tensor:
        """`[B, n]` minus the cost."""
        return torch.where(self.finite & torch.isfinite(self.cost), -self.cost, -torch.inf)

    @property
    def failed(self) -> Tensor:
        """`[B, n]` bool: none, because Algorithm 1 replaces no motions."""
        return torch.zeros_like(self.finite)

    @property
    def active(self) -> Tensor:
        """`[B, n]` bool: all, because line 9 predicts whole sequences."""
        return torch.ones_like(self.finite)


class TrackingCost(NamedTuple):
    """Line 10: squared distance of the predicted states to the chosen subgoals, segment by segment.

    Segments after the end of the chosen effect plan have no subgoal and do not count.
    """

    subgoals: State  # [B, K, M, .]
    segments: Tensor  # [B] int64, 1..K: segments until the effect plan ends
    distance: SubgoalDistance

    def start(self, plans: State) -> TrackingState:
        """The state of candidates without a segment, `plans: [B, n]`."""
        nothing = plans.centers.new_zeros(plans.batch_shape)
        return TrackingState(nothing, nothing, torch.ones_like(nothing, dtype=torch.bool))

    def advance(self, state: TrackingState, segment: int, before: State, rollout: SegmentRollout) -> TrackingState:
        """The state after one more segment from `before: [B, n]`."""
        counts = (segment < self.segments).unsqueeze(-1)  # [B, 1]
        subgoal = self.subgoals.map(lambda field: select_segment(field, segment))  # [B, 1, M, .]
        distance = self.distance(rollout.states, rollout.path, subgoal)
        cost = state.cost + torch.where(counts, distance, 0.0)
        executed = torch.as_tensor(segment == 0, device=counts.device)
        assert rollout.actions is not None
        finite = state.finite & (torch.isfinite(rollout.actions).all(-1).all(-1) | ~counts)
        return TrackingState(cost, torch.where(executed, cost, state.executed_cost), finite)

    def early_stopped(self, state: TrackingState) -> Tensor:
        """`[B]` bool: none, because no sequence ends before the others."""
        return torch.zeros_like(state.finite[:, 0])
