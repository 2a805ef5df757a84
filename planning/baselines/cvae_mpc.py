"""CVAE-MPC as the paper adapts it: a flat generative model of motions (appendix A.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning.baselines.push_search import PushSearch
from planning.protocol import FlatModel, ModelRequirements, RewardFunction
from planning.rollouts.dynamics import predict_states
from planning.rollouts.sampling import sample_codes
from planning.rollouts.segment import SegmentRollout


class FlatMotionSpace(NamedTuple):
    """Motion codes, the pushes that g generates from them alone, and the states that f predicts."""

    model: FlatModel

    @property
    def dimension(self) -> int:
        """Z."""
        return self.model.motion_dimension

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        """See `planning.rollouts.segment.SearchSpace`."""
        z = sample_codes(self.model.motion_prior, [plans], noise, generators)
        a = self.model.actions(here, motion_code=z)
        states, path = predict_states(self.model, here, a)
        return SegmentRollout(z, a, states, path)


class CvaeMpcPlanner(PushSearch):
    """Sequences of K motion codes z ~ p(z | s), T pushes g(s, z) for each, and f's prediction for all H pushes.

    model: p(z | s), g without effect codes, f. For the options and errors see `PushSearch`.
    """

    requires = ModelRequirements("flat", ("motion_prior", "actions", "next_state"), excluded=("effect_prior",))
    has_codes = True

    def __init__(self, model: FlatModel, reward: RewardFunction, **options: Any) -> None:
        """`options` are those of `PushSearch`."""
        super().__init__(FlatMotionSpace(model), model, reward, **options)
