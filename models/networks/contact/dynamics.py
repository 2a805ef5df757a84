"""Dynamics that see contact: each object's outline, read in the frame of the push."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.networks.contact.objects import PAIR_MEASURES, ObjectContact
from models.networks.contact.tool import DISPLACEMENT_UNIT, MEASURES, PUSH_UNIT, ToolContact, endpoints
from models.networks.dynamics import PushOutcome
from models.networks.layers import fully_connected, relative_positions
from models.networks.outline import (
    FEATURES,
    HEIGHTS,
    OUTLINES,
    PER_OUTLINE,
    SPREAD,
    TYPICAL,
    Outline,
    multiples,
    standard_features,
    standard_values,
    turned,
)
from models.state import State

MAXIMUM_DISPLACEMENT = 0.2  # metres, by one push, along each axis
INPUTS = 4 + (OUTLINES * PER_OUTLINE + HEIGHTS) + 5 + MEASURES


class ContactDynamics(PushOutcome):
    """f: mean and scale of the state after one push, from outlines of objects (`models.networks.outline.Outline`).

    In the frame of the push, whose origin is its start and whose x axis is its direction:
    contact_i  = where the tool would meet outline i, and how (`models.networks.contact.tool.ToolContact`)
    object_i   = FC(FC(centre, outline, heights, contact; direction and place on the table))
    alone_i    = linear of object_i: its motion, were the other objects not there
    relation_i = sum over other real objects j of FC(FC(the same of i, the same of j, pair_ij)); pair_ij says where one
                 would push the other, moving as if alone (`models.networks.contact.objects.ObjectContact`)
    motion_i, its scale = alone_i + linear of FC(object_i, relation_i)
    change of shape_i, its scale = linear of FC(FC(the same of i)): layers of their own, because 64 numbers of shape
    outweigh three of motion in the likelihood

    Both changes are turned back. It takes no features of the state encoder. Equivariant to the order of objects;
    padding does not change and does not affect other objects.
    """

    typical: Tensor  # [2 K + 1]
    spread: Tensor

    geometry = Outline
    reads_encoding = False
    predicts_scales = True

    def __init__(
        self,
        *,
        feature_dimension: int = 64,
        width: int = 64,
        object_width: int = 128,
        pair_width: int = 48,
        shape_width: int = 64,
    ) -> None:
        """Widths of the layers for an object, a pair and an object's shape; `width`, of the state encoder, is not read.

        Raises `ValueError` for features that are no outlines.
        """
        if feature_dimension != FEATURES:
            raise ValueError(f"dynamics=contact reads outlines with {FEATURES} numbers, not {feature_dimension}")
        super().__init__()
        self.contact = ToolContact()
        self.object = nn.Sequential(fully_connected(INPUTS, object_width), fully_connected(object_width, object_width))
        self.alone = nn.Linear(object_width, 2)
        self.own, self.other = nn.Linear(INPUTS, pair_width), nn.Linear(INPUTS, pair_width, bias=False)
        self.pairs, self.pair = ObjectContact(), nn.Linear(PAIR_MEASURES, pair_width, bias=False)
        self.relation = fully_connected(pair_width, pair_width)
        self.second = fully_connected(object_width + pair_width, object_width)
        self.head = nn.Linear(object_width, 4)
        self.shape = nn.Sequential(fully_connected(INPUTS, shape_width), fully_connected(shape_width, shape_width))
        self.shape_head = nn.Linear(shape_width, OUTLINES * PER_OUTLINE + HEIGHTS + 1)
        nn.init.zeros_(self.head.bias)
        nn.init.zeros_(self.shape_head.bias)
        for name, values in (("typical", TYPICAL), ("spread", SPREAD)):
            self.register_buffer(name, values[:PER_OUTLINE].clone(), persistent=False)

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
        values = standard_values(state.features)
        shape, heights = values.split((OUTLINES * PER_OUTLINE, HEIGHTS), -1)
        shape = turned(shape, cosines, sines)
        outline = self.typical + self.spread * shape[..., :PER_OUTLINE]
        contact = self.contact(along, across, outline, length)
        place = torch.stack((along / PUSH_UNIT, across / DISPLACEMENT_UNIT, (along - length) / PUSH_UNIT), -1)
        batch = place.shape[:-1]
        each = torch.cat(
            (
                place,
                (length / PUSH_UNIT).unsqueeze(-1).expand(*batch, 1),
                shape.expand(*batch, -1),
                heights.expand(*batch, -1),
                direction.unsqueeze(-2).expand(*batch, 2),
                relative_positions(state.centers).expand(*batch, 3),
                contact,
            ),
            -1,
        )
        move, scale = self._motion(each, torch.stack((along, across), -1), outline, state.mask).split((3, 1), -1)
        shape_change, heights_change, shape_scale = self.shape_head(self.shape(each)).split(
            (OUTLINES * PER_OUTLINE, HEIGHTS, 1), -1
        )
        real = state.mask.unsqueeze(-1)
        forward, sideways, up = (
            MAXIMUM_DISPLACEMENT * (move * (DISPLACEMENT_UNIT / MAXIMUM_DISPLACEMENT)).tanh() * real
        ).unbind(-1)
        moved = torch.stack((forward * cosine - sideways * sine, forward * sine + sideways * cosine, up), -1)
        shape_change = turned(shape_change, cosines, -sines)
        changed = standard_features(values + torch.cat((shape_change, heights_change), -1))
        features = torch.where(real, changed, state.features)
        centers = state.centers + moved
        spread = torch.cat(
            ((0.2 * DISPLACEMENT_UNIT) * scale.clamp(-6.0, 3.0).exp(), 0.05 * shape_scale.clamp(-6.0, 3.0).exp()), -1
        )
        return State(centers, features, state.mask.expand(centers.shape[:-1])), spread

    def _motion(self, each: Tensor, place: Tensor, outline: Tensor, mask: Tensor) -> Tensor:
        """Motion in units of `DISPLACEMENT_UNIT` and the logarithm of its scale, `[..., M, 4]`."""
        alone = self.object(each)
        motion = self.alone(alone)
        own, other = self.own(each), self.other(each)
        relation = torch.zeros_like(own)
        for shift, pair in enumerate(self.pairs(place, outline, *_aim(motion.detach() * mask.unsqueeze(-1))), 1):
            related = self.relation((own + other.roll(shift, -2) + self.pair(pair)).relu_())
            relation = relation + related * mask.roll(shift, -1).unsqueeze(-1)
        return functional.pad(motion, (0, 2)) + self.head(self.second(torch.cat((alone, relation), -1)))


def _aim(motion: Tensor) -> tuple[Tensor, Tensor]:
    """Direction `[..., 2]` and length, in metres, of motions in units of `DISPLACEMENT_UNIT`."""
    length = motion.square().sum(-1, keepdim=True).clamp_min(1e-6).sqrt()
    return motion / length, DISPLACEMENT_UNIT * length.squeeze(-1)
