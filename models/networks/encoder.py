"""State features shared by all networks of the cascade: a relation network (paper, appendix A.1)."""

from __future__ import annotations

from functools import reduce
from operator import add

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.networks.layers import fully_connected, relative_positions
from models.networks.neighbours import neighbours
from models.state import State


class StateEncoder(nn.Module):
    """Spatial, geometric and relation features of each object.

    spatial_i   = FC(center_i)
    geometric_i = FC(feature_i)
    relation_i  = sum over other real objects j of FC(FC(center_j - center_i))

    Of more than `neighbours` others the nearest enter the sum. Equivariant to the order of objects; padding does not
    affect the features of real objects.
    """

    def __init__(self, *, feature_dimension: int = 64, width: int = 64, neighbours: int | None = None) -> None:
        """`neighbours`: None sums over all others, as in the paper."""
        super().__init__()
        self.feature_dimension = feature_dimension
        self.neighbours = neighbours
        self.spatial = fully_connected(3, width)
        self.geometric = fully_connected(feature_dimension, width)
        self.difference = nn.Linear(3, width)
        self.relation = fully_connected(width, width)

    def forward(self, state: State) -> Tensor:
        """`state: [...]` of `M` objects -> `[..., M, 3 * width]`.

        Raises `ValueError` for features of another length.
        """
        if state.features.shape[-1] != self.feature_dimension:
            raise ValueError(
                f"features have {state.features.shape[-1]} numbers per object; "
                f"this model expects {self.feature_dimension}"
            )
        positions = relative_positions(state.centers)
        spatial = self.spatial(positions)
        # The layer is linear in the difference: W p_j - (W p_i - b) takes M products instead of M squared.
        others = functional.linear(positions, self.difference.weight)
        own = others - self.difference.bias
        related = [
            self.relation((other.of(others) - own).relu_()) * other.real.unsqueeze(-1)
            for other in reversed(neighbours(state.centers, state.mask, self.neighbours))
        ]
        relations = reduce(add, related) if related else torch.zeros_like(spatial)
        return torch.cat((spatial, self.geometric(state.features), relations), -1)
