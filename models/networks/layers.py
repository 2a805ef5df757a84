"""Small layers that the networks share (paper, appendix A.1)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from pyro import distributions
from pyro.distributions import TorchDistribution
from torch import Tensor, nn
from torch.nn import functional

TABLE_CENTER = (0.6, 0.0, 0.0)  # metres, in the robot's base frame
POSITION_UNIT = 0.1  # metres; about the length of a push, so that inputs of networks are of order one
SCALE_FLOOR = 1e-6  # lower bound on standard deviations, so that densities stay finite
_FIXED = ContextVar("_FIXED", default=False)


@contextmanager
def fixed_shapes() -> Iterator[None]:
    """Within it the shapes of all tensors must follow from the shapes of arguments, as in graphs that are exported.

    Results are the same up to rounding; what need not be computed is computed all the same.
    """
    token = _FIXED.set(True)
    try:
        yield
    finally:
        _FIXED.reset(token)


def shapes_are_fixed() -> bool:
    """Whether the caller is within `fixed_shapes`: else a shape may depend on values, such as objects within reach."""
    return torch.compiler.is_compiling() or _FIXED.get()


def fully_connected(inputs: int, outputs: int) -> nn.Sequential:
    """One "FC layer" of the paper: linear, then ReLU. `[..., inputs] -> [..., outputs]`."""
    return nn.Sequential(nn.Linear(inputs, outputs), nn.ReLU(inplace=True))


def relative_positions(centers: Tensor) -> Tensor:
    """`centers: [..., 3]` metres -> positions from the table's centre, in units of 0.1 m.

    Raw coordinates of about 0.6 m differ by only a few centimetres; centring and scaling makes such differences visible
    to a network.
    """
    # Filled where the centres are: a copy from the CPU would let a GPU wait, and CUDA graphs have none.
    origin = torch.cat([centers.new_full((1,), coordinate) for coordinate in TABLE_CENTER])
    return (centers - origin) / POSITION_UNIT


def unit(values: Tensor) -> Tensor:
    """Scale to unit length along the last dimension; zeros stay zeros."""
    return functional.normalize(values, dim=-1)


class ObjectPool(nn.Module):
    """Softmax-weighted mean over the real objects, invariant to their order."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.score = nn.Linear(width, 1, bias=False)  # softmax is invariant to a bias

    def forward(self, objects: Tensor, mask: Tensor) -> Tensor:
        """`objects: [..., M, width]`, `mask: [..., M]` bool -> `[..., width]`."""
        scores = self.score(objects).squeeze(-1)
        # The smallest finite number, not -inf: a scene without objects must not give NaN.
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
        # Softplus is ten times slower on tensors that are not contiguous.
        return distributions.Normal(mean, functional.softplus(scale.contiguous()) + SCALE_FLOOR).to_event(1)

    def initialize_standard(self) -> GaussianCode:
        """Initialise the weights so that the code is N(0, I) for every feature; returns self."""
        mean, scale = self.head.bias.detach().chunk(2)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(mean)
        nn.init.constant_(scale, math.log(math.expm1(1 - SCALE_FLOOR)))
        return self
