"""Where the tool meets objects and pushed objects meet each other, from outlines: without learned numbers."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from cavin_pyro.models.networks.contact.rows import Pairs
from cavin_pyro.models.networks.outline import (
    DIRECTIONS,
    HARMONICS,
    OUTLINE_UNIT,
    PER_OUTLINE,
    multiples,
    series,
    supports,
)

REACH_LOW, REACH_HIGH = (0.30, -0.55), (0.80, 0.55)  # metres; where starts and ends of pushes may lie
REACH = torch.tensor((REACH_LOW, REACH_HIGH), dtype=torch.float64)
TABLE_CENTER = (0.6, 0.0, 0.0)  # metres, in the robot's base frame
PUSH_UNIT = 0.1  # metres, maximum motion of the tool along an axis
DISPLACEMENT_UNIT = 0.05  # metres, a typical motion of an object
TOOL_RADIUS = 0.01  # metres
CORNER = 0.004  # metres; of two sides that the tool meets within so little, both count
MEASURES = 8
PAIR_MEASURES = 12
CARRIED = 0.01  # metres; an object may be carried so much farther than the tool goes


class ToolContact(nn.Module):
    """The tool, a disc that moves along the x axis of the push's frame, against half planes around each outline.

    An outline's extent in a direction is a half plane that the object does not leave. Moving along x, the disc enters
    those whose normals point against x, leaves those whose normals point along x, and stays beside the others.
    """

    normals: Tensor  # [2, N] of N half planes: the E that are entered, as many that are left, and those beside
    extents: Tensor  # [N, 2 K + 1], from a series to metres in their directions
    units: Tensor  # [MEASURES] units per metre
    slowness: Tensor  # [2 E], distance along the push per distance to the half plane; its negative for those left

    def __init__(self) -> None:
        super().__init__()
        angles = torch.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS)
        facing = angles.cos()
        order = torch.cat([chosen.nonzero()[:, 0] for chosen in (facing < -1e-3, facing > 1e-3, facing.abs() < 1e-3)])
        self.entered = int((facing < -1e-3).sum())
        angles = angles[order]
        normals = torch.stack((angles.cos(), angles.sin()))
        weights = torch.full((PER_OUTLINE,), 2.0 * OUTLINE_UNIT)
        weights[0] = OUTLINE_UNIT
        self.register_buffer("normals", normals, persistent=False)
        self.register_buffer("extents", series(angles) * weights, persistent=False)
        lengths = 1 / PUSH_UNIT, 1 / DISPLACEMENT_UNIT, 1 / PUSH_UNIT, 1 / PUSH_UNIT, 1.0, 1.0, 1.0, 1 / PUSH_UNIT
        self.register_buffer("units", torch.tensor(lengths), persistent=False)
        self.register_buffer("slowness", 1.0 / normals[0, : 2 * self.entered].abs(), persistent=False)

    def forward(self, along: Tensor, across: Tensor, outline: Tensor, length: Tensor) -> Tensor:
        """How a push meets each object: lengths in units of `PUSH_UNIT`, the chord in units of `DISPLACEMENT_UNIT`.

        Components come first, so that loops run over candidates.

        `along`, `across`: `[...]` metres, the object's centre from the push's start. `outline`: `[2 K + 1, ...]`, in
        the push's frame. `length`: metres, of the push; broadcasts to `[...]`.

        Returns `[MEASURES, ...]`: the way until the tool enters; the chord that it would cut, negative if it passes
        beside; the way that is left then, and the same if it hits at all; the normal of the side that it meets (x, y)
        and its y if it hits at all; the distance from the start to the object, negative inside.
        """
        outline = outline.expand(-1, *along.shape)
        extents = (self.extents @ outline.flatten(1)).unflatten(1, along.shape) + TOOL_RADIUS
        ones = along.dim() * [1]
        x, y = (each.view(-1, *ones) for each in self.normals)
        gaps = torch.addcmul(torch.addcmul(extents, x, along), y, across).neg()  # metres from start, positive outside
        crossed, beside = gaps[: 2 * self.entered], gaps[2 * self.entered :].amax(0)
        times = crossed * self.slowness.view(-1, *ones)
        enter, leave = times[: self.entered].amax(0), -times[self.entered :].amax(0)
        chord = torch.where(beside > 0, -beside, leave - enter).clamp(-0.2, 0.2)
        rest = (length - enter).clamp(-0.1, 0.2)
        hit = ((chord > 0) & (rest > 0)).to(along.dtype)
        sharp = (times[: self.entered] / CORNER).softmax(0)
        normal_x, normal_y = (self.normals[:, : self.entered] @ sharp.flatten(1)).unflatten(1, along.shape)
        enter, inside = enter.clamp(-0.2, 0.3), crossed.amax(0)
        measures = (enter, chord, rest, rest * hit, normal_x, normal_y, hit * normal_y, inside)
        return torch.stack(measures) * self.units.view(-1, *ones)


def on_table(centers: Tensor) -> Tensor:
    """Places from the table's centre in units of `PUSH_UNIT`: `[3, R]`, from `centers: [3, R]` metres."""
    # Filled where the centres are: a copy from the CPU would let a GPU wait, and CUDA graphs have none.
    origin = torch.cat([centers.new_full((1, 1), coordinate) for coordinate in TABLE_CENTER])
    return (centers - origin) / PUSH_UNIT


def endpoints(action: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
    """Start and motion `[..., 2]` metres of normalised pushes `[..., 4]`, as the robot executes them.

    `reach`: `REACH`, on the device of the pushes.
    """
    low, high = reach.to(action)
    action = action.clamp(-1.0, 1.0)
    start = low + (action[..., :2] + 1.0) * ((high - low) / 2.0)
    end = torch.add(start, action[..., 2:], alpha=PUSH_UNIT).clamp(low, high)
    return start, end - start


def pair_contact(place: Tensor, outlines: Tensor, aim: Tensor, carried: Tensor, pairs: Pairs) -> Tensor:
    """Measures of pairs of objects, of which the tool would carry each along its aim, a direction of its own.

    The way until a carried object meets another is their distance along the aim, less how far both reach in that
    direction. It passes if the gap across the aim is positive. Components come first and objects second.

    Args:
        place: `[2, R]` metres, centres in axes of the push. outlines: `[2 K + 1, R]`, in the same axes.
        aim: `[2, R]` vectors of any length. carried: `[R]` metres along the aim, 0 without contact.
        pairs: tells which objects these are.

    Returns `[PAIR_MEASURES, P]` of object i and another j, in units of `DISPLACEMENT_UNIT`: where i is, seen from j,
    and where j would push it; if j were carried: the way until it meets i, the gap between them across the aim, how far
    it would push i; the same three for i and j exchanged; how far both are carried.
    """
    cosines, sines = multiples(*aim)
    sizes = 2, PER_OUTLINE, HARMONICS, HARMONICS, 1
    # Whole rows of a matrix are copied faster than columns.
    each = torch.cat((place, outlines, cosines, sines, carried.unsqueeze(0))).T.contiguous()
    (place, outline, *_), (own_place, own_outline, cosines, sines, carried) = (
        each.index_select(0, which).T.contiguous().split(sizes) for which in (pairs.first, pairs.second)
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


def in_reach(along: Tensor, across: Tensor, length: Tensor, radius: Tensor, margin: float) -> Tensor:
    """Whether the tool, or an object that the tool moves, comes within a margin of an object: `[M, ...]` bool.

    An object that the tool meets is taken for a disc that is carried along the push for the rest of its way. Objects
    that such objects push are not asked what they push.

    `along`, `across`: `[M, ...]` metres, centres from the push's start, in its axes. `length`: `[...]` metres, of the
    push; broadcasts to `[M, ...]`. `radius`: `[M, ...]` metres, mean extent of the objects. `margin`: metres.
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
