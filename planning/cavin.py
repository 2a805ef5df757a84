"""Hierarchical planning with cascaded generative processes (paper, section 3.2, Algorithm 1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from models.state import State
from planning.bulk import in_bulk
from planning.candidates import Search
from planning.effects import choose_effects
from planning.idle import idle_last
from planning.inputs import check_weight
from planning.levels import EffectLevel, MotionLevel
from planning.motions import Closeness, choose_motions
from planning.optimisers import make_optimiser
from planning.plan import Plan
from planning.protocol import PlanningModel, RewardFunction
from planning.reachability import Reachability, most_reachable
from planning.robustness import Robustness
from planning.searching import SearchingPlanner

MOTION_HORIZONS = ("full_horizon", "first_segment")


class CavinPlanner(SearchingPlanner):
    """First *what* to achieve (effect codes, ranked by reward), then *how* (motion codes, ranked by aim).

    model: h, g, f and their priors.
    reward: the task.
    samples: N, at both levels.
    horizon: H steps, a multiple of the model's T.
    optimizer: how codes are searched: `shooting` (paper), `cem`, `icem`, `mppi`, `evolution` or `smc`, with
        `optimizer_options` of its own (see `planning.optimisers`); at both levels, unless `motion_optimizer`, with
        `motion_optimizer_options`, searches the motions.
    reward_at: `path` rewards interpolated states as well (paper), `subgoals` only the subgoals (published
        implementation).
    stride_limits: metres, two of them; a subgoal towards which every object moves less than the first, or any more
        than the second, ends the plan as a violation does (published implementation: 0.1 and 0.3); None in the paper.
    motion_horizon: `full_horizon` plans motions for all K segments and compares them with all K subgoals
        (paper); `first_segment` plans and compares only what is executed before the next plan (published
        implementation).
    feature_weight: square metres per squared unit of feature distance, in "closest to the subgoals"; 0
        compares centres only.
    avoid_failures: our addition to line 10. If true, motion sequences along which f predicts a failure, step
        by step, lose against those without one; where every sequence fails somewhere, those that fail in the
        executed segment lose against those that fail later. If false, only the distance counts, as in the
        paper's text.
    robustness: our addition to line 10, how the best motions are tried again with displaced pushes; None to take
        the best at its word, as in the paper.
    idle_distance: metres; our addition to line 10: of the executed segment, pushes that f predicts to move no object
        as far come last. 0 leaves g's order, as in the paper.
    memory: our addition to line 5: what is left of the last plan is among the candidates (`planning.memory`).
    reachability: our addition to line 7, how the best effects are scored again by what motions do for them; None to
        take h at its word, as in the paper.

    Raises ValueError for counts below 1, a horizon that T does not divide, an unknown `motion_horizon`, `optimizer` or
    `reward_at`, limits out of order, and a `feature_weight` or an `idle_distance` that is negative or not finite.
    """

    needs = ("effect_prior", "motion_prior", "subgoal", "actions", "next_state")
    usual_model = "cascaded"

    def __init__(
        self,
        model: PlanningModel,
        reward: RewardFunction,
        samples: int = 1024,
        horizon: int = 30,
        motion_horizon: str = "full_horizon",
        *,
        motion_optimizer: str | None = None,
        motion_optimizer_options: Mapping[str, Any] | None = None,
        feature_weight: float = 0.0,
        avoid_failures: bool = True,
        robustness: Robustness | None = None,
        idle_distance: float = 0.0,
        reachability: Reachability | None = None,
        **options: Any,
    ) -> None:
        super().__init__(model, reward, samples, horizon, **options)
        if motion_horizon not in MOTION_HORIZONS:
            raise ValueError(f"unknown motion_horizon '{motion_horizon}': take {' or '.join(MOTION_HORIZONS)}")
        check_weight("feature_weight", feature_weight)
        check_weight("idle_distance", idle_distance)
        self.motion_optimiser = self.optimiser
        if motion_optimizer is not None:
            self.motion_optimiser = make_optimiser(motion_optimizer, motion_optimizer_options, samples=samples)
        self.motion_segments = self.segments if motion_horizon == "full_horizon" else 1
        self.feature_weight = feature_weight
        self.avoid_failures = avoid_failures
        self.robustness = robustness
        self.idle_distance = idle_distance
        self.reachability = reachability
        self.best_only = reachability is None  # it looks at many

    @in_bulk
    @torch.inference_mode()
    def plan(self, state: State, generators: Sequence[torch.Generator], previous: Plan | None = None) -> Plan:
        """Plan for observed scenes `state: [B]`; `generators`: one per environment, which the call advances.

        `previous`: the last plans of the same episodes, whose first pushes have been executed, for a planner with a
        memory. An environment's plan depends on its own state, generator and last plan only. For errors see
        `planning.bulk.in_bulk`.
        """
        # Lines 2, 3, 11 and 12 (repeat until the episode is done, execute, t = t + T) are the caller's.
        # Line 4, the new s_t, is what it was given.
        # Lines 5 to 7: choose the effect codes c* and their subgoals.
        plans = self.search(EffectLevel(self.model), state, generators, previous)
        chosen = None  # the highest return, as h predicts it
        if self.reachability is not None:
            chosen = most_reachable(self.reachability, plans, self.model, self.reward)
        effects = choose_effects(plans, chosen)
        # Lines 8 to 10: choose the motion codes z* and their actions.
        closeness = Closeness(
            effects, self.reward, feature_weight=self.feature_weight, avoid_failures=self.avoid_failures
        )
        level, segments = MotionLevel(self.model, effects.codes), self.motion_segments
        how = Search(level, closeness, state, generators, segments, self.from_noise, engine=self.engine)
        sequences = self.motion_optimiser.optimise(how, self.samples)
        motions = choose_motions(sequences, self.model, closeness, self.robustness)
        motions = idle_last(motions, state, self.segment_length, self.idle_distance)
        return Plan(
            actions=motions.actions[:, : self.segment_length],
            planned_actions=motions.actions,
            effect_codes=effects.codes,
            motion_codes=motions.codes,
            subgoals=effects.subgoals,
            segments=effects.segments,
            predicted_centers=motions.predicted_centers,
            expected_return=effects.expected_return,
            expected_success=effects.expected_success,
            candidate_centers=effects.candidate_centers,
            noise=effects.noise,
            candidate_returns=effects.candidate_returns,
        )
