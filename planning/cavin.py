"""Hierarchical planning with cascaded generative processes (paper, section 3.2, Algorithm 1)."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from models.state import State
from planning.effects import plan_effects
from planning.inputs import check_horizon, check_model, check_positive, check_scenes, check_weight
from planning.motions import plan_motions
from planning.plan import Plan
from planning.protocol import PlanningModel, RewardFunction
from planning.robustness import Robustness

MOTION_HORIZONS = ("full_horizon", "first_segment")


class CavinPlanner:
    """First *what* to achieve (effect codes, ranked by reward), then *how* (motion codes, ranked by aim).

    model: h, g, f and their priors.
    reward: the task.
    samples: N, at both levels.
    horizon: H steps, a multiple of the model's T.
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

    Raises ValueError for a model that lacks one of these, counts below 1, a horizon that T does not divide, an
    unknown `motion_horizon`, and a `feature_weight` that is negative or not finite.
    """

    def __init__(
        self,
        model: PlanningModel,
        reward: RewardFunction,
        samples: int = 1024,
        horizon: int = 30,
        motion_horizon: str = "full_horizon",
        *,
        feature_weight: float = 0.0,
        avoid_failures: bool = True,
        robustness: Robustness | None = None,
    ) -> None:
        check_model(model)
        check_positive("samples", samples)
        check_horizon(horizon, model.segment_length)
        if motion_horizon not in MOTION_HORIZONS:
            raise ValueError(f"unknown motion_horizon '{motion_horizon}': take {' or '.join(MOTION_HORIZONS)}")
        check_weight("feature_weight", feature_weight)
        self.model = model
        self.reward = reward
        self.samples = samples
        self.segments = horizon // model.segment_length  # line 1: K = H / T
        self.motion_segments = self.segments if motion_horizon == "full_horizon" else 1
        self.feature_weight = feature_weight
        self.avoid_failures = avoid_failures
        self.robustness = robustness

    @torch.inference_mode()
    def plan(self, state: State, generators: Sequence[torch.Generator]) -> Plan:
        """Plan for observed scenes `state: [B]`; `generators`: one per environment, which the call advances.

        An environment's plan depends on its own state and generator only. Not for several threads at once:
        torch's global generator is borrowed and given back. Raises ValueError for a state that is not a batch
        of scenes, for another number of generators than B, and where an environment has no finite candidate.
        """
        # Lines 2, 3, 11 and 12 (repeat until the episode is done, execute, t = t + T) are the caller's.
        check_scenes(state, generators)  # line 4: the new s_t
        effects = plan_effects(  # lines 5 to 7: choose the effect codes c* and their subgoals
            self.model, self.reward, state, generators, samples=self.samples, segments=self.segments
        )
        motions = plan_motions(  # lines 8 to 10: choose the motion codes z* and their actions
            self.model,
            self.reward,
            state,
            effects,
            generators,
            samples=self.samples,
            segments=self.motion_segments,
            feature_weight=self.feature_weight,
            avoid_failures=self.avoid_failures,
            robustness=self.robustness,
        )
        return Plan(
            actions=motions.actions[:, : self.model.segment_length],
            planned_actions=motions.actions,
            effect_codes=effects.codes,
            motion_codes=motions.codes,
            subgoals=effects.subgoals,
            segments=effects.segments,
            predicted_centers=motions.predicted_centers,
            expected_return=effects.expected_return,
            expected_success=effects.expected_success,
            candidate_centers=effects.candidate_centers,
            candidate_returns=effects.candidate_returns,
        )
