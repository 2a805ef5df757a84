"""Learned priors of the codes, p(c | s) and p(z | s, c), in the place of the paper's N(0, I).

Both begin at N(0, I), so that training starts where the paper's does, and are called as `StandardPrior` is.
`TraceMeanField_ELBO` finds the divergence of Gaussian guides from `ConditionalPrior` in closed form. Where the prior or
the guide is a flow there is none, and it takes the draws that `Trace_ELBO` takes.
"""

from __future__ import annotations

import torch
from pyro import distributions
from pyro.distributions import TorchDistribution
from torch import Tensor, nn
from torch.nn import functional

from models.flows import CodeFlow
from models.layers import GaussianCode, fully_connected, relative_positions
from models.state import State


class SceneContext(nn.Module):
    """A state, and an effect code if there is one, in a few numbers; cheap enough for every sample of a plan.

    Per object two FC on (center, feature, effect code); sum over real objects; FC. The order of objects and what
    stands in padding change nothing.
    """

    def __init__(self, *, feature_dimension: int, effect_dimension: int | None, width: int) -> None:
        super().__init__()
        self.from_object = nn.Linear(3 + feature_dimension, width)
        self.from_code = None if effect_dimension is None else nn.Linear(effect_dimension, width, bias=False)
        self.objects = fully_connected(width, width)
        self.scene = fully_connected(width, width)

    def forward(self, state: State, effect_code: Tensor | None) -> Tensor:
        """`state: [...]`, `effect_code: [..., C]` -> `[..., width]`; leading dimensions broadcast.

        Raises `ValueError` for an effect code where none is wanted, and for none where one is.
        """
        hidden = self._object_features(state)
        if self.from_code is not None and effect_code is not None:
            hidden = hidden + self.from_code(effect_code).unsqueeze(-2)
        elif self.from_code is not None or effect_code is not None:
            wanted = "takes no effect code" if effect_code is not None else "needs the effect code"
            raise ValueError(f"this prior {wanted}: effect_dimension says whether it is p(z | s, c) or p(c | s)")
        objects = self.objects(hidden.relu_()) * state.mask.unsqueeze(-1)
        return self.scene(objects.sum(-2))

    def _object_features(self, state: State) -> Tensor:
        """What `from_object` says of (center, feature): `[..., M, width]`."""
        positions, layer = relative_positions(state.centers), self.from_object
        if not torch.compiler.is_compiling():
            return layer(torch.cat((positions, state.features), -1))
        # Native code is faster without the joined copy, and computes the positions' share where the sum is read.
        columns = layer.weight.t().contiguous()  # [3 + F, width]
        total = functional.linear(state.features, layer.weight[:, 3:], layer.bias)
        for position, column in zip(positions.split(1, -1), columns[:3], strict=True):
            total = total + position * column
        return total


class ConditionalPrior(nn.Module):
    """Diagonal Gaussian p(c | s) or p(z | s, c)."""

    def __init__(
        self,
        *,
        dimension: int = 16,
        feature_dimension: int = 64,
        effect_dimension: int | None = None,
        width: int = 32,
    ) -> None:
        """`dimension` is the code's; `effect_dimension` is C for p(z | s, c), None for p(c | s)."""
        super().__init__()
        self.dimension = dimension
        self.context = SceneContext(feature_dimension=feature_dimension, effect_dimension=effect_dimension, width=width)
        self.code = GaussianCode(dimension, width=width).begin_at_standard()

    def forward(self, state: State, effect_code: Tensor | None = None) -> TorchDistribution:
        """`state: [...]`, `effect_code: [..., C]` for motions -> batch `[...]`, event `[dimension]`."""
        return self.code(self.context(state, effect_code))


class FlowPrior(nn.Module):
    """Normalising flow p(c | s) or p(z | s, c): N(0, I) through couplings that see s and c."""

    def __init__(
        self,
        *,
        dimension: int = 16,
        feature_dimension: int = 64,
        effect_dimension: int | None = None,
        width: int = 32,
        transforms: int = 4,
    ) -> None:
        """`dimension` is the code's; `effect_dimension` is C for p(z | s, c), None for p(c | s)."""
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
