"""Where pushed objects meet each other, from their outlines: geometry without learned numbers."""

from __future__ import annotations

import torch
from torch import Tensor

from models.networks.contact.rows import Pairs, Rows
from models.networks.contact.tool import DISPLACEMENT_UNIT
from models.networks.outline import HARMONICS, PER_OUTLINE, multiples, supports

PAIR_MEASURES = 12


def pair_contact(place: Tensor, outlines: Tensor, aim: Tensor, carried: Tensor, rows: Rows, pairs: Pairs) -> Tensor:
    """Measures of pairs of objects, of which the tool would carry each along its aim, a direction of its own.

    The way until a carried object meets another is their distance along the aim, less how far both reach in that
    direction. It passes if the gap across the aim is positive. Components come first and objects second.

    Args:
        place: `[2, R, ...]` metres, centres in axes of the push. outlines: `[2 K + 1, R, ...]`, in the same axes.
        aim: `[2, R, ...]` vectors of any length. carried: `[R, ...]` metres along the aim, 0 without contact.
        rows, pairs: tell which objects these are.

    Returns:
        `[PAIR_MEASURES, P, ...]` of object i and another j, in units of `DISPLACEMENT_UNIT`: where i is, seen from
        j, and where j would push it; if j were carried: the way until it meets i, the gap between them across the aim,
        how far it would push i; the same three for i and j exchanged; how far both are carried.
    """
    cosines, sines = multiples(*aim)
    sizes = 2, PER_OUTLINE, HARMONICS, HARMONICS, 1
    each = torch.cat((place, outlines, cosines, sines, carried.unsqueeze(0)))
    (place, outline, *_), (own_place, own_outline, cosines, sines, carried) = (
        one.split(sizes) for one in rows.to_pairs(each, pairs)
    )
    extents = supports(torch.stack((own_outline, outline), 1), cosines.unsqueeze(1), sines.unsqueeze(1))
    (own_ahead, _), (_, behind), (own_left, left), (own_right, right) = extents
    offset = place - own_place
    x, y = cosines[0], sines[0]
    along, across = torch.addcmul(offset[0] * x, offset[1], y), torch.addcmul(offset[1] * x, offset[0], y, value=-1)
    meet = along - own_ahead - behind
    gap = torch.maximum(across - own_left - right, -across - own_right - left)
    way = carried.squeeze(0)
    push = (way - meet.clamp_min(0.0)).clamp_min(0.0) * ((gap < 0) & (meet > -0.05))
    # Of j, if it is carried; and the same of i.
    own = torch.stack((meet, gap, push, way))
    other = own.index_select(1, pairs.exchanged)
    return torch.cat((offset, push * cosines[:1], push * sines[:1], own[:3], other, own[3:])) / DISPLACEMENT_UNIT
