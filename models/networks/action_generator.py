"""Action generator g: the pushes of a segment (paper, equation 3, appendix A.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.networks.layers import ObjectPool, fully_connected

START_LIMIT = 5.0  # normalised; soft clip of starts, far outside of the reachable box [-1, 1]


class ActionGenerator(nn.Module):
    """g: mean of the T pushes (x, y, dx, dy) of a segment.

    pooled      = softmax-weighted mean of the effect features of (s, c) over real objects
    transformed = mean(pooled) + scale(pooled) * z
    starts      = 5 tanh(x / 5) of FC(transformed), motions = tanh of FC(transformed)

    With `motion_dimension=None` there is no motion code, and the pushes depend on the pooled feature only.
    """

    def __init__(self, *, segment_length: int = 3, motion_dimension: int | None = 16, width: int = 64) -> None:
        super().__init__()
        self.pool = ObjectPool(width)
        self.transform = None if motion_dimension is None else nn.Linear(width, 2 * motion_dimension)
        inputs = motion_dimension or width
        self.starts = _coordinates(inputs, segment_length, width)
        self.motions = _coordinates(inputs, segment_length, width)

    def forward(self, effect: Tensor, mask: Tensor, motion_code: Tensor | None = None) -> Tensor:
        """`effect: [..., M, width]`, `mask: [..., M]`, `motion_code: [..., D]` -> `[..., T, 4]`.

        Leading dimensions broadcast. Raises `ValueError` if a motion code is missing.
        """
        feature = self.pool(effect, mask)
        if self.transform is not None:
            if motion_code is None:
                raise ValueError("these pushes depend on a motion code; none was given")
            mean, scale = self.transform(feature).chunk(2, -1)
            # Softplus is ten times slower on tensors that are not contiguous.
            feature = mean + functional.softplus(scale.contiguous()) * motion_code
        starts = START_LIMIT * (self.starts(feature) / START_LIMIT).tanh()
        return torch.cat((starts, self.motions(feature).tanh()), -1)


def _coordinates(inputs: int, segment_length: int, width: int) -> nn.Sequential:
    """Two numbers for each of the T pushes: `[..., inputs] -> [..., T, 2]`."""
    return nn.Sequential(
        fully_connected(inputs, width),
        nn.Linear(width, 2 * segment_length),
        nn.Unflatten(-1, (segment_length, 2)),
    )
