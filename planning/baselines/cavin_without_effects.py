"""CAVIN's model without its two levels: an ablation that searches the codes of the cascade together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning.baselines.push_search import PushSearch
from planning.protocol import ModelRequirements, PlanningModel, RewardFunction
from planning.rollouts.dynamics import predict_states
from planning.rollouts.sampling import sample_codes
from planning.rollouts.segment import SegmentRollout


class CascadeSpace(NamedTuple):
    """Effect and motion codes of the cascade, the pushes that g generates from both, and the states that f predicts."""

    model: PlanningModel

    @property
    def dimension(self) -> int:
        """C + Z."""
        return self.model.effect_dimension + self.model.motion_dimension

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        """See `planning.rollouts.segment.SearchSpace`."""
        sizes = self.model.effect_dimension, self.model.motion_dimension
        effect_noise, motion_noise = (None, None) if noise is None else noise.split(sizes, -1)
        c = sample_codes(self.model.effect_prior, [plans], effect_noise, generators)
        z = sample_codes(self.model.motion_prior, [plans, c], motion_noise, generators)
        a = self.model.actions(here, c, z)
        states, path = predict_states(self.model, here, a)
        return SegmentRollout(torch.cat([c, z], -1), a, states, path)


class CavinWithoutEffectsPlanner(PushSearch):
    """Sequences of K pairs of codes c ~ p(c | s), z ~ p(z | s, c), T pushes g(s, c, z) for each, and f's prediction.

    The same generative model as `CavinPlanner`, but planned like CVAE-MPC: no subgoals, and whole sequences ranked by
    cumulative reward. A plan's motion codes are the pairs, `[B, K, C + Z]`.

    model: the cascade, without h. For the options and errors see `PushSearch`.
    """

    requires = ModelRequirements("cascaded", ("effect_prior", "motion_prior", "actions", "next_state"))
    has_codes = True

    def __init__(self, model: PlanningModel, reward: RewardFunction, **options: Any) -> None:
        """`options` are those of `PushSearch`."""
        super().__init__(CascadeSpace(model), model, reward, **options)
