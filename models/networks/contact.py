"""Dynamics that see contact: each object's outline, read in the frame of the push."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from models.networks.dynamics import PushOutcome
from models.networks.layers import fully_connected, relative_positions
from models.networks.outline import (
    DIRECTIONS,
    FEATURES,
    HEIGHTS,
    OUTLINE_UNIT,
    OUTLINES,
    PER_OUTLINE,
    Outline,
    multiples,
    outline_features,
    outline_values,
    series,
    turned,
)
from models.state import State

REACH_LOW, REACH_HIGH = (0.30, -0.55), (0.80, 0.55)  # metres; where starts and ends of pushes may lie
PUSH_UNIT = 0.1  # metres, maximum motion of the tool along an axis
TOOL_RADIUS = 0.01  # metres
MAXIMUM_DISPLACEMENT = 0.2  # metres, by one push, along each axis
DISPLACEMENT_UNIT = 0.05  # metres
# Typical outlines and heights in 200,000 collected pushes, in units of 0.05 m: layers read inputs of order one.
OUTLINE_MEAN, OUTLINE_SPREAD = 0.9, 0.3
ORDER_SPREADS = (0.06, 0.09, 0.02, 0.035, 0.02, 0.02, 0.02, 0.02)  # of coefficients 1 to K
HEIGHT_MEANS = (-0.8, -0.3, -0.1, 0.1, 0.15, 0.15, 0.2, 0.7, 0.3, 0.3, 0.0, 0.1)
HEIGHT_SPREADS = (0.4, 0.3, 0.16, 0.1, 0.14, 0.17, 0.18, 0.2, 0.23, 0.24, 0.14, 0.12)
INPUTS = 4 + (OUTLINES * PER_OUTLINE + HEIGHTS) + 5 + 8


class ContactDynamics(PushOutcome):
    """f: mean and scale of the state after one push, from outlines of objects (`models.networks.outline.Outline`).

    In the frame of the push, whose origin is its start and whose x axis is its direction:
    contact_i  = where the tool, as a disc, would enter and leave the half planes around outline i; how far it would
                 still go; on which side it would meet the object
    object_i   = FC(FC(centre, outline, heights, contact; direction and place on the table))
    relation_i = sum over other real objects j of FC(FC(the same of i, the same of j))
    motion_i, its scale = linear of FC(object_i, relation_i)
    change of shape_i, its scale = linear of FC(FC(the same of i)): layers of their own, because 64 numbers of shape
    outweigh three of motion in the likelihood

    Both changes are turned back. It takes no features of the state encoder. Equivariant to the order of objects;
    padding does not change and does not affect other objects.
    """

    typical: Tensor  # [63]
    spread: Tensor
    entered_normals: Tensor  # [2, N], and [2 K + 1, N] for the extents in their directions
    entered_series: Tensor
    entered_slowness: Tensor  # [N]
    entered_sides: Tensor  # [N, 2]
    left_normals: Tensor
    left_slowness: Tensor
    left_series: Tensor
    beside_normals: Tensor
    beside_series: Tensor

    geometry = Outline
    reads_encoding = False
    predicts_scales = True

    def __init__(
        self,
        *,
        feature_dimension: int = 64,
        width: int = 64,
        object_width: int = 128,
        pair_width: int = 32,
        shape_width: int = 64,
    ) -> None:
        """Widths of the layers for an object, a pair and an object's shape; `width`, of the state encoder, is not read.

        Raises `ValueError` for features that are no outlines.
        """
        if feature_dimension != FEATURES:
            raise ValueError(f"dynamics=contact reads outlines with {FEATURES} numbers, not {feature_dimension}")
        super().__init__()
        self.object = nn.Sequential(fully_connected(INPUTS, object_width), fully_connected(object_width, object_width))
        self.own, self.other = nn.Linear(INPUTS, pair_width), nn.Linear(INPUTS, pair_width, bias=False)
        self.relation = fully_connected(pair_width, pair_width)
        self.second = fully_connected(object_width + pair_width, object_width)
        self.head = nn.Linear(object_width, 4)
        self.shape = nn.Sequential(fully_connected(INPUTS, shape_width), fully_connected(shape_width, shape_width))
        self.shape_head = nn.Linear(shape_width, OUTLINES * PER_OUTLINE + HEIGHTS + 1)
        nn.init.zeros_(self.head.bias)
        nn.init.zeros_(self.shape_head.bias)
        each = torch.tensor((OUTLINE_SPREAD, *ORDER_SPREADS, *ORDER_SPREADS))
        mean = torch.tensor((OUTLINE_MEAN, *(0.0 for _ in each[1:])))
        self.register_buffer(
            "typical", torch.cat((mean.repeat(OUTLINES), torch.tensor(HEIGHT_MEANS))), persistent=False
        )
        self.register_buffer(
            "spread", torch.cat((each.repeat(OUTLINES), torch.tensor(HEIGHT_SPREADS))), persistent=False
        )
        angles = torch.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS)
        weights = torch.full((PER_OUTLINE,), 2.0)
        weights[0] = 1.0
        facing = angles.cos() < -1e-3  # half planes that a push along x can enter; it leaves the opposite ones
        leaving, beside = facing.roll(DIRECTIONS // 2), angles.cos().abs() < 1e-3
        terms = (series(angles) * weights).T
        for name, chosen in (("entered", facing), ("left", leaving), ("beside", beside)):
            normals = torch.stack((angles.cos(), angles.sin()))[:, chosen]
            self.register_buffer(f"{name}_normals", normals.clone(), persistent=False)
            self.register_buffer(f"{name}_series", terms[:, chosen].clone(), persistent=False)
            # Distance along the push per distance to the half plane.
            self.register_buffer(f"{name}_slowness", -1.0 / normals[0], persistent=False)
            self.register_buffer(f"{name}_sides", normals.T.clone(), persistent=False)

    def outcome(self, state: State, encoded: Tensor | None, action: Tensor) -> tuple[State, Tensor]:
        """The mean and scales of `state: [...]` after `action: [..., 4]`, see `PushOutcome`; `encoded` is ignored."""
        start, motion = endpoints(action)
        length = motion.square().sum(-1, keepdim=True).clamp_min(1e-8).sqrt()
        direction = motion / length
        cosine, sine = direction.unsqueeze(-2).unbind(-1)  # [..., 1]
        cosines, sines = multiples(cosine, sine)  # [..., 1, K]

        offset = state.centers[..., :2] - start.unsqueeze(-2)
        along = offset[..., 0] * cosine + offset[..., 1] * sine  # [..., M]
        across = offset[..., 1] * cosine - offset[..., 0] * sine
        values = outline_values(state.features)
        shape, heights = values.split((OUTLINES * PER_OUTLINE, HEIGHTS), -1)
        shape = turned(shape, cosines, sines)
        contact = self._contact(along, across, shape[..., :PER_OUTLINE], length)
        place = torch.stack((along / PUSH_UNIT, across / DISPLACEMENT_UNIT, (along - length) / PUSH_UNIT), -1)
        batch = place.shape[:-1]
        each = torch.cat(
            (
                place,
                (length / PUSH_UNIT).unsqueeze(-1).expand(*batch, 1),
                ((torch.cat((shape, heights.expand(*shape.shape[:-1], -1)), -1) - self.typical) / self.spread).expand(
                    *batch, -1
                ),
                direction.unsqueeze(-2).expand(*batch, 2),
                relative_positions(state.centers).expand(*batch, 3),
                contact,
            ),
            -1,
        )
        move, scale = self._motion(each, state.mask).split((3, 1), -1)
        shape_change, heights_change, shape_scale = self.shape_head(self.shape(each)).split(
            (OUTLINES * PER_OUTLINE, HEIGHTS, 1), -1
        )
        real = state.mask.unsqueeze(-1)
        forward, sideways, up = (
            MAXIMUM_DISPLACEMENT * (move * (DISPLACEMENT_UNIT / MAXIMUM_DISPLACEMENT)).tanh() * real
        ).unbind(-1)
        moved = torch.stack((forward * cosine - sideways * sine, forward * sine + sideways * cosine, up), -1)
        shape_change = turned(shape_change, cosines, -sines)
        changed = outline_features(values + torch.cat((shape_change, heights_change), -1))
        features = torch.where(real, changed, state.features)
        centers = state.centers + moved
        spread = torch.cat(
            ((0.2 * DISPLACEMENT_UNIT) * scale.clamp(-6.0, 3.0).exp(), 0.05 * shape_scale.clamp(-6.0, 3.0).exp()), -1
        )
        return State(centers, features, state.mask.expand(centers.shape[:-1])), spread

    def _contact(self, along: Tensor, across: Tensor, outline: Tensor, length: Tensor) -> Tensor:
        """Where the tool meets the outline: `[..., M]` and `[..., M, 2 K + 1]` -> `[..., M, 8]`."""
        place = torch.stack((along, across), -1)

        def gap(normals: Tensor, terms: Tensor) -> Tensor:
            """Metres from the tool's start to each half plane, positive outside."""
            return -(place @ normals) - OUTLINE_UNIT * (outline @ terms) - TOOL_RADIUS

        entered = gap(self.entered_normals, self.entered_series)
        left = gap(self.left_normals, self.left_series)
        times = entered * self.entered_slowness
        enter = times.amax(-1)
        leave = (left * self.left_slowness).amin(-1)
        beside = gap(self.beside_normals, self.beside_series).amax(-1)
        chord = torch.where(beside > 0, -beside, leave - enter).clamp(-0.2, 0.2)
        rest = (length - enter).clamp(-0.1, 0.2)
        hit = ((chord > 0) & (rest > 0)).to(along.dtype)
        sharp = ((times - enter.unsqueeze(-1)) / 0.004).softmax(-1)  # metres; smooth where two sides meet
        normal = sharp @ self.entered_sides
        return torch.stack(
            (
                enter.clamp(-0.2, 0.3) / PUSH_UNIT,
                chord / DISPLACEMENT_UNIT,
                rest / PUSH_UNIT,
                rest * hit / PUSH_UNIT,
                normal[..., 0],
                normal[..., 1],
                hit * normal[..., 1],
                torch.maximum(entered.amax(-1), left.amax(-1)) / PUSH_UNIT,
            ),
            -1,
        )

    def _motion(self, each: Tensor, mask: Tensor) -> Tensor:
        own, other = self.own(each), self.other(each)
        objects = each.shape[-2]
        related = [
            self.relation((own + other.roll(-shift, -2)).relu_()) * mask.roll(-shift, -1).unsqueeze(-1)
            for shift in range(1, objects)
        ]
        relation = sum(related) if related else torch.zeros_like(own)
        return self.head(self.second(torch.cat((self.object(each), relation), -1)))


def endpoints(action: Tensor) -> tuple[Tensor, Tensor]:
    """Start and motion `[..., 2]` metres of normalised pushes `[..., 4]`, as the robot executes them."""
    starts, motions = [], []
    for axis, (low, high) in enumerate(zip(REACH_LOW, REACH_HIGH, strict=True)):  # numbers, no tensors, for compilers
        start = low + (action[..., axis].clamp(-1.0, 1.0) + 1.0) * ((high - low) / 2.0)
        end = (start + PUSH_UNIT * action[..., 2 + axis].clamp(-1.0, 1.0)).clamp(low, high)
        starts.append(start)
        motions.append(end - start)
    return torch.stack(starts, -1), torch.stack(motions, -1)
