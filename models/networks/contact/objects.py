"""Where pushed objects meet each other, from their outlines: geometry without learned numbers."""

from __future__ import annotations

import torch
from torch import Tensor

from models.networks.contact.tool import DISPLACEMENT_UNIT
from models.networks.outline import multiples, supports

PAIR_MEASURES = 12


def pair_contact(place: Tensor, outlines: Tensor, aim: Tensor, carried: Tensor) -> Tensor:
    """Measures of every pair of objects, of which the tool would carry each along its aim, a direction of its own.

    The way until a carried object meets another is their distance along the aim, less how far both reach in that
    direction. It passes if the gap across the aim is positive. Components come first and objects second.

    Args:
        place: `[2, M, ...]` metres, centres in axes of the push. outlines: `[2 K + 1, M, ...]`, in the same axes.
        aim: `[2, M, ...]` unit vectors. carried: `[M, ...]` metres along the aim, 0 without contact.

    Returns:
        `[PAIR_MEASURES, M, M, ...]` of object i and another j, in units of `DISPLACEMENT_UNIT`: where i is, seen from
        j, and where j would push it; if j were carried: the way until it meets i, the gap between them across the aim,
        how far it would push i; the same three for i and j exchanged; how far both are carried. On the diagonal the
        numbers mean nothing.
    """
    # Of j, which is carried, and i: [., j, i, ...].
    offset = place.unsqueeze(1) - place.unsqueeze(2)
    x, y = aim.unsqueeze(2)
    along, across = offset[0] * x + offset[1] * y, offset[1] * x - offset[0] * y
    cosines, sines = (values.unsqueeze(2) for values in multiples(*aim))
    ahead, behind, left, right = supports(outlines.unsqueeze(1), cosines, sines)
    own_ahead, own_left, own_right = (values.diagonal().movedim(-1, 0).unsqueeze(1) for values in (ahead, left, right))
    meet = along - own_ahead - behind
    gap = torch.maximum(across - own_left - right, -across - own_right - left)
    way = carried.unsqueeze(1).expand_as(meet)
    push = (way - meet.clamp_min(0.0)).clamp_min(0.0) * ((gap < 0) & (meet > -0.05))
    pushed = push * x, push * y
    exchanged = (values.transpose(0, 1) for values in (meet, gap, push, way))
    measures = (*offset, *pushed, meet, gap, push, *exchanged, way)
    return torch.stack([values.transpose(0, 1) for values in measures]) / DISPLACEMENT_UNIT
