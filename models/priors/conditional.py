"""A learned Gaussian prior of a code, instead of the paper's N(0, I)."""

from __future__ import annotations

from typing import Any

from pyro.distributions import TorchDistribution
from torch import Tensor

from cavin_pyro.models.networks.layers import GaussianCode
from cavin_pyro.models.priors.prior import LearnedPrior
from cavin_pyro.models.state import State


class ConditionalPrior(LearnedPrior):
    """Diagonal Gaussian p(c | s) or p(z | s, c).

    It is initialised to N(0, I), the paper's prior. `TraceMeanField_ELBO` computes the divergence of
    Gaussian guides from it in closed form.
    """

    def __init__(self, *, width: int = 32, **shared: Any) -> None:
        """`shared`: the arguments of `LearnedPrior`."""
        super().__init__(width=width, **shared)
        self.code = GaussianCode(self.dimension, width=width).initialize_standard()

    def forward(self, state: State, effect_code: Tensor | None = None) -> TorchDistribution:
        """`state: [...]`, `effect_code: [..., C]` for motions -> batch `[...]`, event `[dimension]`."""
        return self.code(self.context(state, effect_code))
