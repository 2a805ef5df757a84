"""A learned Gaussian prior of a code, instead of the paper's N(0, I)."""

from __future__ import annotations

from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from models.networks.layers import GaussianCode
from models.priors.prior import SceneContext
from models.state import State


class ConditionalPrior(nn.Module):
    """Diagonal Gaussian p(c | s) or p(z | s, c).

    It is initialised to N(0, I), the paper's prior. `TraceMeanField_ELBO` computes the divergence of
    Gaussian guides from it in closed form.
    """

    def __init__(
        self,
        *,
        dimension: int = 16,
        feature_dimension: int = 64,
        effect_dimension: int | None = None,
        width: int = 32,
    ) -> None:
        """The layers.

        Args:
            dimension: of the code.
            feature_dimension: F of the states.
            effect_dimension: C for p(z | s, c), None for p(c | s).
            width: width of all layers.
        """
        super().__init__()
        self.dimension = dimension
        self.context = SceneContext(feature_dimension=feature_dimension, effect_dimension=effect_dimension, width=width)
        self.code = GaussianCode(dimension, width=width).initialize_standard()

    def forward(self, state: State, effect_code: Tensor | None = None) -> TorchDistribution:
        """`state: [...]`, `effect_code: [..., C]` for motions -> batch `[...]`, event `[dimension]`."""
        return self.code(self.context(state, effect_code))
