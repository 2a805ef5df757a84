"""A normalizing flow as the prior of a code, instead of the paper's N(0, I)."""

from __future__ import annotations

from pyro import distributions
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from models.networks.flows import CodeFlow
from models.priors.prior import SceneContext
from models.state import State


class FlowPrior(nn.Module):
    """Normalizing flow p(c | s) or p(z | s, c): N(0, I) through couplings conditioned on s and c.

    It is initialised to N(0, I), the paper's prior. Divergences from a flow have no closed form:
    `TraceMeanField_ELBO` uses the one-sample estimate of `Trace_ELBO`.
    """

    def __init__(
        self,
        *,
        dimension: int = 16,
        feature_dimension: int = 64,
        effect_dimension: int | None = None,
        width: int = 32,
        transforms: int = 4,
    ) -> None:
        """The layers.

        Args:
            dimension: of the code.
            feature_dimension: F of the states.
            effect_dimension: C for p(z | s, c), None for p(c | s).
            width: width of all layers.
            transforms: number of couplings of the flow.
        """
        super().__init__()
        self.dimension = dimension
        self.context = SceneContext(feature_dimension=feature_dimension, effect_dimension=effect_dimension, width=width)
        self.flow = CodeFlow(dimension, width, width=width, transforms=transforms)

    def forward(self, state: State, effect_code: Tensor | None = None) -> TorchDistribution:
        """`state: [...]`, `effect_code: [..., C]` for motions -> batch `[...]`, event `[dimension]`."""
        context = self.context(state, effect_code)
        zero, one = context.new_zeros(()), context.new_ones(())
        base = distributions.Normal(zero, one).expand((*context.shape[:-1], self.dimension)).to_event(1)
        return self.flow(base, context)
