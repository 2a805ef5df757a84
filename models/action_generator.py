"""Action generator g: pushes that bring about an effect (paper, equation 3, appendix A.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.layers import ObjectPool, fully_connected

START_LIMIT = 5.0  # normalised; a soft clip far outside the reachable box [-1, 1], against runaway starts


class ActionGenerator(nn.Module):
    """g: mean of the T pushes (x, y, dx, dy) of a segment.

    pooled      = softmax-weighted mean of the effect features of (s, c) over real objects
    transformed = mean(pooled) + scale(pooled) * z
    starts      = 5 tanh(x / 5) of FC(transformed), motions = tanh of FC(transformed)
    """

    def __init__(self, *, segment_length: int = 3, motion_dimension: int = 16, width: int = 64) -> None:
        super().__init__()
        self.pool = ObjectPool(width)
        self.transform = nn.Linear(width, 2 * motion_dimension)
        self.starts = nn.Sequential(
            fully_connected(motion_dimension, width),
            nn.Linear(width, 2 * segment_length),
            nn.Unflatten(-1, (segment_length, 2)),
        )
        self.motions = nn.Sequential(
            fully_connected(motion_dimension, width),
            nn.Linear(width, 2 * segment_length),
            nn.Unflatten(-1, (segment_length, 2)),
        )

    def forward(self, effect: Tensor, mask: Tensor, motion_code: Tensor) -> Tensor:
        """`effect: [..., M, width]`, `mask: [..., M]`, `motion_code: [..., D]` -> `[..., T, 4]`.

        Leading dimensions broadcast.
        """
        mean, scale = self.transform(self.pool(effect, mask)).chunk(2, -1)
        transformed = mean + functional.softplus(scale) * motion_code
        starts = START_LIMIT * (self.starts(transformed) / START_LIMIT).tanh()
        return torch.cat((starts, self.motions(transformed).tanh()), -1)
