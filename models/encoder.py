"""State features shared by all networks of the cascade: a relation network (paper, appendix A.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.layers import fully_connected, relative_positions
from models.state import State


class StateEncoder(nn.Module):
    """Spatial, geometric and relation features of each object.

    spatial_i   = FC(center_i)
    geometric_i = FC(feature_i)
    relation_i  = sum over other real objects j of FC(FC(center_j - center_i))

    Reordering the objects reorders the features; padding does not touch the features of real objects.
    """

    def __init__(self, *, feature_dimension: int = 64, width: int = 64, maximum_objects: int = 5) -> None:
        super().__init__()
        self.feature_dimension = feature_dimension
        self.maximum_objects = maximum_objects
        self.spatial = fully_connected(3, width)
        self.geometric = fully_connected(feature_dimension, width)
        self.difference = nn.Linear(3, width)
        self.relation = fully_connected(width, width)

    def forward(self, state: State) -> Tensor:
        """`state: [...]` of `M` objects -> `[..., M, 3 * width]`.

        Raises `ValueError` for more objects than the model was made for, or features of another length.
        """
        if state.objects > self.maximum_objects:
            raise ValueError(f"state has {state.objects} objects; this model knows at most {self.maximum_objects}")
        if state.features.shape[-1] != self.feature_dimension:
            raise ValueError(
                f"features have {state.features.shape[-1]} numbers per object; "
                f"this model expects {self.feature_dimension}"
            )
        spatial, others = self._of_positions(relative_positions(state.centers))
        return torch.cat((spatial, self.geometric(state.features), self._relations(others, state.mask)), -1)

    def _of_positions(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Spatial features, and W p of the first relation layer: `[..., M, 3]` in 0.1 m -> twice `[..., M, width]`."""
        first, difference = self.spatial[0], self.difference
        assert isinstance(first, nn.Linear)
        if not torch.compiler.is_compiling():
            return self.spatial(positions), functional.linear(positions, difference.weight)
        # A product costs native code some 20 microseconds, however small it is.
        weight = torch.cat((first.weight, difference.weight))
        bias = torch.cat((first.bias, torch.zeros_like(difference.bias)))
        spatial, others = functional.linear(positions, weight, bias).chunk(2, -1)
        return spatial.relu(), others

    def _relations(self, others: Tensor, mask: Tensor) -> Tensor:
        """`others: [..., M, width]`, W p of every object, `mask: [..., M]` -> `[..., M, width]`."""
        # The first layer is linear in the difference, W (p_j - p_i) + b = W p_j - (W p_i - b): M products
        # instead of M squared. Pairs are visited by cyclic shifts, so that no object meets itself.
        own = others - self.difference.bias
        total = torch.zeros_like(others)
        for shift in range(1, others.shape[-2]):
            hidden = (others.roll(-shift, -2) - own).relu_()
            total = total + self.relation(hidden) * mask.roll(-shift, -1).unsqueeze(-1)
        return total
