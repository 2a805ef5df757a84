"""Windows mirrored in the plane y = 0, which are as likely: table, reach and camera are symmetric about it."""

from __future__ import annotations

import torch
from torch import Tensor

from models.state import State, Window


def reflect(window: Window, which: Tensor, signs: Tensor) -> Window:
    """Mirror some of the windows `[B]`.

    Args:
        which: `[B]` bool. signs: `[F]`, of features, see `Geometry.mirror_signs`.
    """
    flip = 1.0 - 2.0 * which.to(window.actions.dtype)[:, None]  # [B, 1]
    same = torch.ones_like(flip)
    centers = window.states.centers * torch.cat((same, flip, same), 1)[:, None, None]
    features = torch.where(which[:, None, None, None], window.states.features * signs, window.states.features)
    actions = window.actions * torch.cat((same, flip, same, flip), 1)[:, None]
    return window._replace(states=State(centers, features, window.states.mask), actions=actions)
