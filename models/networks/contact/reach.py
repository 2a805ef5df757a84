"""Which objects a push can move, from where they lie and how wide they are: geometry without learned numbers."""

from __future__ import annotations

import torch
from torch import Tensor

from models.networks.contact.tool import TOOL_RADIUS

CARRIED = 0.01  # metres; an object may be carried so much farther than the tool goes


def in_reach(along: Tensor, across: Tensor, length: Tensor, radius: Tensor, margin: float) -> Tensor:
    """Whether the tool, or an object that the tool moves, comes within a margin of an object: `[M, ...]` bool.

    An object that the tool meets is taken for a disc that is carried along the push for the rest of its way. Objects
    that such objects push are not asked what they push.

    Args:
        along, across: `[M, ...]` metres, centres from the push's start, in its axes. length: `[...]` metres, of the
            push; broadcasts to `[M, ...]`. radius: `[M, ...]` metres, mean extent of the objects. margin: metres.
    """
    met = _squared_distance(along, across, length) < (radius + (TOOL_RADIUS + margin)).square()
    if len(along) == 1:
        return met
    rest = (length - (along - radius - TOOL_RADIUS).clamp_min(0.0)).clamp_min(0.0) + CARRIED
    # Of j, which is carried, and i: [i, j, ...].
    ahead, aside = along.unsqueeze(1) - along, across.unsqueeze(1) - across
    close = radius.unsqueeze(1) + (radius + (CARRIED + margin))
    pushed = (_squared_distance(ahead, aside, rest) < close.square()) & met
    return met | pushed.any(1)


def _squared_distance(along: Tensor, across: Tensor, length: Tensor) -> Tensor:
    """Of places from the way from 0 to `length` along the first axis: square metres."""
    beyond = along - torch.minimum(along.clamp_min(0.0), length)
    return torch.addcmul(beyond.square(), across, across)
