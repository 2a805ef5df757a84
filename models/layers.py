"""Small layers that every network of the cascade is made of (paper, appendix A.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

TABLE_CENTER = (0.6, 0.0, 0.0)  # metres, in the robot's base frame
POSITION_UNIT = 0.1  # metres; a push moves things by about this much, so networks see numbers of size one


def fully_connected(inputs: int, outputs: int) -> nn.Sequential:
    """One "FC layer" of the paper: linear, then ReLU. `[..., inputs] -> [..., outputs]`."""
    return nn.Sequential(nn.Linear(inputs, outputs), nn.ReLU(inplace=True))


def relative_positions(centers: Tensor) -> Tensor:
    """`centers: [..., 3]` metres -> positions from the table's centre, in units of 0.1 m.

    Raw coordinates of some 0.6 m differ by a few centimetres from case to case; centred and scaled,
    what is near and what touches becomes visible to a network.
    """
    return (centers - centers.new_tensor(TABLE_CENTER)) / POSITION_UNIT


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
