"""A normalizing flow as the prior of a code, instead of the paper's N(0, I)."""

from __future__ import annotations

from typing import Any

from pyro import distributions
from pyro.distributions import TorchDistribution
from torch import Tensor

from cavin_pyro.models.networks.flows import CodeFlow
from cavin_pyro.models.priors.prior import LearnedPrior
from cavin_pyro.models.state import State


class FlowPrior(LearnedPrior):
    """Normalizing flow p(c | s) or p(z | s, c): N(0, I) through couplings conditioned on s and c.

    It is initialised to N(0, I), the paper's prior. Divergences from a flow have no closed form:
    `TraceMeanField_ELBO` uses the one-sample estimate of `Trace_ELBO`.
    """

    def __init__(self, *, width: int = 32, transforms: int = 4, **shared: Any) -> None:
        """`transforms`: number of couplings of the flow. `shared`: the arguments of `LearnedPrior`."""
        super().__init__(width=width, **shared)
        self.flow = CodeFlow(self.dimension, width, width=width, transforms=transforms)

    def forward(self, state: State, effect_code: Tensor | None = None) -> TorchDistribution:
        """`state: [...]`, `effect_code: [..., C]` for motions -> batch `[...]`, event `[dimension]`."""
        context = self.context(state, effect_code)
        zero, one = context.new_zeros(()), context.new_ones(())
        base = distributions.Normal(zero, one).expand((*context.shape[:-1], self.dimension)).to_event(1)
        return self.flow(base, context)
