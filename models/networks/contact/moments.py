"""Second moments of a cloud in axes that are turned, for an f that does not know the table's directions."""

from __future__ import annotations

import torch
from torch import Tensor

from models.networks.outline import HEIGHT_MEANS, HEIGHT_SPREADS, PRODUCT


def turned_moments(heights: Tensor, cosine: Tensor, sine: Tensor, *, differences: bool = False) -> Tensor:
    """Heights with their means of x x, y y and x y in axes that are turned by an angle, components first.

    `heights: [12, ...]`, less their mean, over their spread; `cosine, sine: [...]` of twice the angle of the new x
    axis; leading dimensions broadcast. `differences`: of such heights, from which no mean was taken.
    """
    heights = heights.expand(-1, *torch.broadcast_shapes(heights.shape[1:], cosine.shape))
    before, moments, after = heights.split((PRODUCT - 2, 3, 1))
    offsets = [0.0, 0.0, 0.0] if differences else HEIGHT_MEANS[PRODUCT - 2 : PRODUCT + 1]
    spreads = HEIGHT_SPREADS[PRODUCT - 2 : PRODUCT + 1]
    xx, yy, xy = (one * spread + offset for one, spread, offset in zip(moments, spreads, offsets, strict=True))
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    new_half, new_xy = half * cosine + xy * sine, xy * cosine - half * sine
    new = zip((mean + new_half, mean - new_half, new_xy), spreads, offsets, strict=True)
    return torch.cat((before, torch.stack([(one - offset) / spread for one, spread, offset in new]), after))
