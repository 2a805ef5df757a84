"""Contact-aware dynamics: they read each object's outline in the frame of the push."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import torch
from torch import Tensor, nn

from models.networks.contact.objects import PAIR_MEASURES, pair_contact
from models.networks.contact.tool import DISPLACEMENT_UNIT, MEASURES, PUSH_UNIT, ToolContact, endpoints
from models.networks.dynamics import PushOutcome
from models.networks.layers import fully_connected, relative_positions
from models.networks.neighbours import nearest_pairs
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
                 would push the other, moving as if alone (`models.networks.contact.objects.pair_contact`)
    motion_i, its scale = alone_i + linear of FC(object_i, relation_i)
    change of shape_i, its scale = linear of FC(FC(the same of i)): layers of their own, because 64 numbers of shape
    outweigh three of motion in the likelihood

    Of more than `neighbours` others the nearest enter relation_i. Both changes are turned back. It takes no features of
    the state encoder. Equivariant to the order of objects; padding does not change and does not affect other objects.
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
        self.pair = nn.Linear(PAIR_MEASURES, pair_width, bias=False)
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
        # In here components come first and objects second, [C, M, ...]: loops then run over candidates.
        start, motion = (values.movedim(-1, 0).contiguous().unsqueeze(1) for values in endpoints(action))  # [2, 1, ...]
        length = motion.square().sum(0).clamp_min(1e-8).sqrt()
        cosine, sine = direction = motion / length
        cosines, sines = multiples(cosine, sine)  # [K, 1, ...]

        ranks = action.dim() - 1
        centers, features, real = (_components_first(field, ranks) for field in (*state[:2], state.mask.unsqueeze(-1)))
        x, y = centers[:2] - start
        along, across = x * cosine + y * sine, y * cosine - x * sine  # [M, ...]
        batch = along.shape
        values = standard_values(features)
        shape, heights = values.split((OUTLINES * PER_OUTLINE, HEIGHTS))
        shape = turned(shape.unflatten(0, (OUTLINES, PER_OUTLINE)), cosines, sines)
        outline = _each(self.typical, batch) + _each(self.spread, batch) * shape[0]
        contact = self.contact(along, across, outline, length)
        table = _components_first(relative_positions(state.centers), ranks)
        place = torch.stack((along / PUSH_UNIT, across / DISPLACEMENT_UNIT, (along - length) / PUSH_UNIT))
        parts = (place, (length / PUSH_UNIT).unsqueeze(0), shape.flatten(0, 1), heights, direction, table, contact)
        each = torch.cat([part.expand(-1, *batch) for part in parts])
        each = each.flatten(1).T  # [M ..., INPUTS]

        move, scale = self._motion(each, torch.stack((along, across)), outline, real.squeeze(0)).split((3, 1))
        change = _unflat(self.shape_head(self.shape(each)), batch)
        shape_change, heights_change, shape_scale = change.split((OUTLINES * PER_OUTLINE, HEIGHTS, 1))
        forward, sideways, up = MAXIMUM_DISPLACEMENT * (move * (DISPLACEMENT_UNIT / MAXIMUM_DISPLACEMENT)).tanh() * real
        moved = torch.stack((forward * cosine - sideways * sine, forward * sine + sideways * cosine, up))
        shape_change = turned(shape_change.unflatten(0, (OUTLINES, PER_OUTLINE)), cosines, -sines).flatten(0, 1)
        changed = standard_features(values + torch.cat((shape_change, heights_change)))
        features = torch.where(real, changed, features)
        spread = torch.cat(
            ((0.2 * DISPLACEMENT_UNIT) * scale.clamp(-6.0, 3.0).exp(), 0.05 * shape_scale.clamp(-6.0, 3.0).exp())
        )
        centers, features, spread = (_components_last(field) for field in (centers + moved, features, spread))
        return State(centers, features, state.mask.expand(centers.shape[:-1])), spread

    def _motion(self, each: Tensor, place: Tensor, outline: Tensor, real: Tensor) -> Tensor:
        """Motion in units of `DISPLACEMENT_UNIT` and the logarithm of its scale, `[4, M, ...]`.

        each: `[M ..., INPUTS]`. place: `[2, M, ...]`. outline: `[2 K + 1, M, ...]`. real: `[M, ...]`.
        """
        batch, objects = place.shape[1:], len(place[0])
        alone = self.object(each)
        motion = _unflat(self.alone(alone), batch)
        relation = each.new_zeros(len(each), self.pair.out_features)
        if objects > 1:
            measures = pair_contact(place, outline, *_aim(motion.detach() * real))
            pairs, second = _pairs(objects, each.device)
            hidden = self.pair(measures.flatten(1, 2).index_select(1, pairs).flatten(1).T)
            own, other = (layer(each).unflatten(0, (objects, -1)) for layer in (self.own, self.other))
            hidden = hidden.unflatten(0, (objects, objects - 1, -1)) + own.unsqueeze(1)
            hidden = (hidden.flatten(0, 1) + other.index_select(0, second)).relu_()
            counts = real.expand(batch).index_select(0, second)
            if self.neighbours is not None and objects - 1 > self.neighbours:
                near = nearest_pairs(
                    place.movedim((0, 1), (-1, -2)), real.expand(batch).movedim(0, -1), self.neighbours
                )
                counts = counts * near.movedim((-2, -1), (0, 1)).flatten(0, 1).index_select(0, pairs)
            related = self.relation(hidden) * counts.flatten(1).unsqueeze(-1)
            relation = related.unflatten(0, (objects, -1)).sum(1).flatten(0, 1)
        after = self.head(self.second(torch.cat((alone, relation), -1)))
        return torch.cat((motion, torch.zeros_like(motion))) + _unflat(after, batch)


def _components_first(values: Tensor, ranks: int) -> Tensor:
    """`[..., M, C]` -> `[C, M, ...]`, with at least as many leading dimensions as `ranks`."""
    values = values.movedim((-1, -2), (0, 1)).contiguous()
    return values.reshape(values.shape[:2] + (ranks + 2 - values.dim()) * (1,) + values.shape[2:])


def _components_last(values: Tensor) -> Tensor:
    """`[C, M, ...]` -> `[..., M, C]`, contiguous, for the next matrix product. Two copies are faster than one."""
    return values.flatten(1).T.contiguous().unflatten(0, values.shape[1:]).movedim(0, -2).contiguous()


def _each(values: Tensor, batch: Sequence[int]) -> Tensor:
    """`[C]` -> `[C, 1, ..., 1]`, which broadcasts to `[C, *batch]`."""
    return values.view(-1, *len(batch) * [1])


def _unflat(values: Tensor, batch: Sequence[int]) -> Tensor:
    """Rows `[prod(batch), C]` -> components `[C, *batch]`."""
    return values.T.contiguous().unflatten(1, batch)


def _pairs(objects: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Numbers of all ordered pairs of different objects, of `M^2`, and of the second object of each; M (M - 1)."""
    pairs = torch.tensor([objects * i + j for i, j in permutations(range(objects), 2)], device=device)
    return pairs, pairs % objects


def _aim(motion: Tensor) -> tuple[Tensor, Tensor]:
    """Direction `[2, ...]` and length, in metres, of motions in units of `DISPLACEMENT_UNIT`."""
    length = motion.square().sum(0).clamp_min(1e-6).sqrt()
    return motion / length, DISPLACEMENT_UNIT * length
