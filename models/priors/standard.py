"""Priors of the codes: p(c) and p(z) (paper, section 3.1)."""

from __future__ import annotations

import torch
from pyro import distributions
from pyro.distributions import TorchDistribution
from torch import Tensor

from cavin_pyro.models.part import Part
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State


class StandardPrior(Part):
    """N(0, I) for every state (the paper's prior), without layers; of its dimensions, see `Prior`, one is read."""

    def __init__(
        self,
        *,
        space: Space | None = None,
        dimension: int = 16,
        feature_dimension: int = 64,
        effect_dimension: int | None = None,
    ) -> None:
        super().__init__()
        self.dimension = dimension

    def forward(self, state: State, effect_code: Tensor | None = None) -> TorchDistribution:
        """`state: [...]`, `effect_code: [..., C]` for motions -> batch `[...]`, event `[dimension]`."""
        shape = state.batch_shape
        if effect_code is not None:
            shape = torch.broadcast_shapes(shape, effect_code.shape[:-1])
        zero, one = state.centers.new_zeros(()), state.centers.new_ones(())
        return distributions.Normal(zero, one).expand((*shape, self.dimension)).to_event(1)
