"""Layers that the networks share, and the encoder of states: a relation network (paper, appendix A.1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial, reduce
from operator import add
from typing import NamedTuple

import torch
from pyro import distributions
from pyro.distributions import TorchDistribution
from torch import Tensor, nn
from torch.nn import functional

from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State

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


class StateEncoder(nn.Module):
    """Spatial, geometric and relation features of each object.

    spatial_i   = FC(center_i)
    geometric_i = FC(feature_i)
    relation_i  = sum over other real objects j of FC(FC(center_j - center_i))

    Centres are as the space locates and describes them.

    Of more than `neighbours` others the nearest enter the sum. Equivariant to the order of objects; padding does not
    affect the features of real objects.
    """

    def __init__(
        self, space: Space, *, feature_dimension: int = 64, width: int = 64, neighbours: int | None = None
    ) -> None:
        """`neighbours`: None sums over all others, as in the paper."""
        super().__init__()
        self.space = space
        self.feature_dimension = feature_dimension
        self.neighbours = neighbours
        self.spatial = fully_connected(space.inputs, width)
        self.geometric = fully_connected(feature_dimension, width)
        self.difference = nn.Linear(space.positions, width)
        self.relation = fully_connected(width, width)

    def forward(self, state: State) -> Tensor:
        """`state: [...]` of `M` objects -> `[..., M, 3 * width]`.

        Raises `ValueError` for features or centres of another length.
        """
        self.space.check(state, self.feature_dimension)
        positions = self.space.locate(state)
        spatial = self.spatial(self.space.describe(state, positions))
        # The layer is linear in the difference: W p_j - (W p_i - b) takes M products instead of M squared.
        others = functional.linear(positions, self.difference.weight)
        own = others - self.difference.bias
        related = [
            self.relation((other.of(others) - own).relu_()) * other.real.unsqueeze(-1)
            for other in reversed(neighbours(state.centers, state.mask, self.neighbours))
        ]
        relations = reduce(add, related) if related else torch.zeros_like(spatial)
        return torch.cat((spatial, self.geometric(state.features), relations), -1)


class Neighbour(NamedTuple):
    """One other object for each object of a scene."""

    of: Callable[[Tensor], Tensor]  # `[..., M, D]`, with any leading dimensions -> the row of each one's neighbour
    real: Tensor  # [..., M] bool, whether it is an object, not padding


def squared_distances(centers: Tensor, mask: Tensor) -> Tensor:
    """In the plane of the first two numbers, between all objects: `[..., M, M]`, infinite to itself and to padding.

    `centers: [..., M, 2 or more]`, `mask: [..., M]`.
    """
    x, y = centers[..., 0], centers[..., 1]
    squared = (x.unsqueeze(-1) - x.unsqueeze(-2)).square() + (y.unsqueeze(-1) - y.unsqueeze(-2)).square()
    own = torch.eye(mask.shape[-1], dtype=torch.bool, device=mask.device)
    return squared.masked_fill(own | ~mask.unsqueeze(-2), torch.inf)


def nearest_pairs(centers: Tensor, mask: Tensor, most: int) -> Tensor:
    """Whether object j is among the `most` nearest others of object i: `[..., M, M]` bool, for networks of all pairs.

    `centers: [..., M, 2 or more]`, `mask: [..., M]` bool. It may be true of padding.
    """
    squared = squared_distances(centers, mask.bool())
    return squared <= squared.topk(most, largest=False).values[..., -1:]


def neighbours(centers: Tensor, mask: Tensor, most: int | None) -> list[Neighbour]:
    """For each object the other objects that enter its relations, at most `most` of them.

    All others where there are no more than `most`, or if it is None; else the nearest, so that relation
    sums do not grow in a crowded scene, and their cost grows with the number of objects, not with its square.

    `centers`: `[..., M, 2 or more]`. `mask`: `[..., M]`.
    """
    others = mask.shape[-1] - 1
    if most is None or others <= most:
        shifts = range(1, others + 1)  # visit all pairs of different objects
        return [Neighbour(partial(torch.roll, shifts=shift, dims=-2), mask.roll(shift, -1)) for shift in shifts]
    with torch.no_grad():
        nearest = squared_distances(centers, mask).topk(most, largest=False, sorted=False)
    real = nearest.values.isfinite()
    return [Neighbour(partial(_rows, nearest.indices[..., n].contiguous()), real[..., n]) for n in range(most)]


def _rows(index: Tensor, values: Tensor) -> Tensor:
    """The rows `index: [..., M]` of `values: [..., M, D]`, which may have more leading dimensions."""
    objects = values.shape[-2]
    index = index.expand(values.shape[:-1])
    scenes = torch.arange(0, index.numel(), objects, device=index.device).reshape(*index.shape[:-1], 1)
    # Whole rows of a matrix: ten times faster than `gather`, whose index has an entry for each number.
    rows = (index + scenes).flatten()
    return values.reshape(-1, values.shape[-1]).index_select(0, rows).reshape(values.shape)
