"""Small layers that every network of the cascade is made of (paper, appendix A.1)."""

from __future__ import annotations

import math
from functools import reduce
from operator import add, mul

import torch
from pyro import distributions
from pyro.distributions import TorchDistribution
from torch import Tensor, nn
from torch.nn import functional

TABLE_CENTER = (0.6, 0.0, 0.0)  # metres, in the robot's base frame
POSITION_UNIT = 0.1  # metres; a push moves things by about this much, so networks see numbers of size one
SCALE_FLOOR = 1e-6  # keeps the density of a code finite
FEW = 4  # inputs of a layer that native code computes without a product


class Linear(nn.Linear):
    """Torch's, which native code computes without a product where the inputs are few.

    A product costs native code some 30 microseconds, however small it is, and rounds what it reads to bfloat16. What
    is added up number by number costs little more than writing it, and is rounded once.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs)

    def forward(self, inputs: Tensor) -> Tensor:
        """`[..., inputs] -> [..., outputs]`."""
        if self.in_features > FEW or not torch.compiler.is_compiling():
            return super().forward(inputs)
        written = torch.cat([inputs[..., :1], inputs[..., 1:]], -1)  # what is joined is not computed again and again
        numbers, weights = written.unsqueeze(-1).unbind(-2), self.weight.T.contiguous().unbind()
        result = reduce(add, map(mul, numbers, weights), self.bias)
        device = inputs.device.type  # rounded as products are
        return result.to(torch.get_autocast_dtype(device)) if torch.is_autocast_enabled(device) else result


def fully_connected(inputs: int, outputs: int) -> nn.Sequential:
    """One "FC layer" of the paper: linear, then ReLU. `[..., inputs] -> [..., outputs]`."""
    return nn.Sequential(Linear(inputs, outputs), nn.ReLU(inplace=True))


def relative_positions(centers: Tensor) -> Tensor:
    """`centers: [..., 3]` metres -> positions from the table's centre, in units of 0.1 m.

    Raw coordinates of some 0.6 m differ by a few centimetres from case to case; centred and scaled,
    what is near and what touches becomes visible to a network.
    """
    offsets = centers - centers.new_tensor(TABLE_CENTER)
    # A division takes native code several times as long as a product.
    return offsets * (1 / POSITION_UNIT) if torch.compiler.is_compiling() else offsets / POSITION_UNIT


def unit(values: Tensor) -> Tensor:
    """Scaled to unit length along the last dimension; zeros stay zeros."""
    if not torch.compiler.is_compiling():
        return functional.normalize(values, dim=-1)
    return values * values.square().sum(-1, keepdim=True).clamp(min=1e-24).rsqrt()  # see `relative_positions`


class ObjectPool(nn.Module):
    """Softmax-weighted mean over the real objects, whatever their order."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.score = nn.Linear(width, 1, bias=False)  # softmax would not see a bias

    def forward(self, objects: Tensor, mask: Tensor) -> Tensor:
        """`objects: [..., M, width]`, `mask: [..., M]` bool -> `[..., width]`."""
        scores = self.score(objects).squeeze(-1)
        # The smallest finite number, not -inf: a scene without objects then gives numbers, not NaN.
        scores = scores.masked_fill(~mask, torch.finfo(scores.dtype).min)
        return (scores.softmax(-1).unsqueeze(-1) * objects).sum(-2)


class GaussianCode(nn.Module):
    """A diagonal Gaussian over a code, from a feature."""

    def __init__(self, dimension: int, *, width: int = 64) -> None:
        super().__init__()
        self.head = nn.Linear(width, 2 * dimension)

    def forward(self, feature: Tensor) -> TorchDistribution:
        """`feature: [..., width]` -> batch `[...]`, event `[dimension]`."""
        mean, scale = self.head(feature).chunk(2, -1)
        # Softplus is ten times slower where numbers are apart in memory.
        return distributions.Normal(mean, functional.softplus(scale.contiguous()) + SCALE_FLOOR).to_event(1)

    def begin_at_standard(self) -> GaussianCode:
        """Set the weights so that the code is N(0, I) whatever the feature; returns itself."""
        mean, scale = self.head.bias.detach().chunk(2)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(mean)
        nn.init.constant_(scale, math.log(math.expm1(1 - SCALE_FLOOR)))
        return self
