"""Contact-aware dynamics: they read each object's outline in the frame of the push."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cavin_pyro.models.networks.contact.geometry import (
    DISPLACEMENT_UNIT,
    MEASURES,
    PAIR_MEASURES,
    PUSH_UNIT,
    REACH,
    ToolContact,
    endpoints,
    in_reach,
    on_table,
    pair_contact,
)
from cavin_pyro.models.networks.contact.rows import Pairs, Rows, components_first, near_pairs
from cavin_pyro.models.networks.dynamics import Outcome
from cavin_pyro.models.networks.layers import fully_connected, shapes_are_fixed
from cavin_pyro.models.networks.outline import (
    FEATURES,
    HEIGHTS,
    OUTLINES,
    PER_OUTLINE,
    SPREAD,
    TYPICAL,
    Outline,
    mean_extent,
    multiples,
    standard_features,
    standard_values,
    turned,
    turned_moments,
)
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State

MAXIMUM_DISPLACEMENT = 0.2  # metres, by one push, along each axis
PUSHES = 3, ("start", "motion")  # numbers of a position, and parts of an action
PLACE = 4  # numbers that say where on the table an object lies, and where a push points to
INPUTS = 5 + (OUTLINES * PER_OUTLINE + HEIGHTS) + MEASURES + PLACE


class ContactDynamics(Outcome):
    """f: mean and scale of the state after one push, from outlines of objects (`Outline`).

    In the frame of the push, whose origin is its start and whose x axis is its direction:
    contact_i  = where the tool would meet outline i, and how (`contact.geometry.ToolContact`)
    object_i   = FC(FC(centre, outline, heights, contact; height of the centre, direction and place on the table))
    alone_i    = linear of object_i: its motion, were the other objects not there
    relation_i = sum over other real objects j of FC(FC(the same of i, the same of j, pair_ij)); pair_ij says where one
                 would push the other, moving as if alone (`contact.geometry.pair_contact`)
    motion_i, its scale = alone_i + linear of FC(object_i, relation_i)
    change of shape_i, its scale = linear of FC(FC(the same of i)): layers of their own, because 64 numbers of shape
    outweigh three of motion in the likelihood

    Of more than `neighbours` others the nearest enter relation_i. Both changes are turned back. It takes no features of
    the state encoder. Equivariant to the order of objects; padding does not change and does not affect other objects.

    With a `reach_margin` objects out of the push's reach (`contact.geometry.in_reach`) stay as they are, to within
    `still_scale`, do not enter relations, and are not computed where shapes may depend on values (`fixed_shapes`).
    """

    typical: Tensor  # [2 K + 1]
    spread: Tensor
    reach: Tensor  # [2, 2] metres
    still_scale: Tensor  # [2] logarithms, of centres and of features, as the layers predict them

    geometry = Outline
    reads_encoding = False
    predicts_scales = True

    def __init__(
        self,
        space: Space | None = None,
        *,
        feature_dimension: int = 64,
        width: int = 64,
        object_width: int = 128,
        pair_width: int = 48,
        shape_width: int = 64,
        reach_margin: float | None = None,
        equivariant: bool = False,
    ) -> None:
        """The layers.

        Args:
            space: of the world, in which an action must be a push.
            feature_dimension: numbers of an outline.
            width: width of the state encoder, which f does not read.
            object_width: width of the layers for an object.
            pair_width: width of the layers for a pair of objects.
            shape_width: width of the layers for the change of an object's shape.
            reach_margin: metres by which a push may pass an object that it can move; None computes all objects.
            equivariant: whether f is equivariant to turns and shifts of the table.

        Raises ValueError: another world, features that are no outlines, or a negative margin.
        """
        if space is not None and (space.positions, space.action_names) != PUSHES:
            raise ValueError("dynamics=contact is for pushes on a table: choose dynamics=paper")
        if feature_dimension != FEATURES:
            raise ValueError(f"dynamics=contact reads outlines with {FEATURES} numbers, not {feature_dimension}")
        if reach_margin is not None and not reach_margin >= 0:
            raise ValueError(f"reach_margin must be null or at least 0 metres, not {reach_margin}")
        super().__init__()
        self.reach_margin, self.equivariant = reach_margin, equivariant
        inputs = INPUTS - PLACE if equivariant else INPUTS
        self.contact = ToolContact()
        self.object = nn.Sequential(fully_connected(inputs, object_width), fully_connected(object_width, object_width))
        self.alone = nn.Linear(object_width, 2)
        self.own, self.other = nn.Linear(inputs, pair_width), nn.Linear(inputs, pair_width, bias=False)
        self.pair = nn.Linear(PAIR_MEASURES, pair_width, bias=False)
        self.relation = fully_connected(pair_width, pair_width)
        self.second = fully_connected(object_width + pair_width, object_width)
        self.head = nn.Linear(object_width, 4)
        self.shape = nn.Sequential(fully_connected(inputs, shape_width), fully_connected(shape_width, shape_width))
        self.shape_head = nn.Linear(shape_width, OUTLINES * PER_OUTLINE + HEIGHTS + 1)
        nn.init.zeros_(self.head.bias)
        nn.init.zeros_(self.shape_head.bias)
        for name, values in (("typical", TYPICAL), ("spread", SPREAD)):
            self.register_buffer(name, values[:PER_OUTLINE].clone(), persistent=False)
        self.register_buffer("reach", REACH.clone(), persistent=False)
        if reach_margin is None:
            self.register_buffer("still_scale", torch.zeros(2), persistent=False)  # of padding, which is not read
        else:
            self.still_scale = nn.Parameter(torch.zeros(2))

    def forward(self, state: State, encoded: Tensor | None, action: Tensor) -> State:
        """See `Outcome`; `encoded` is ignored."""
        return self._predict(state, action)[0]

    def outcome(self, state: State, encoded: Tensor | None, action: Tensor) -> tuple[State, Tensor]:
        """The mean and scales of `state: [...]` after `action: [..., 4]`, see `Outcome`; `encoded` is ignored."""
        mean, rows, scales = self._predict(state, action)
        still = _scales(self.still_scale.unsqueeze(1)).T.expand(state.objects, -1)
        return mean, rows.write(still, _scales(scales))

    def _predict(self, state: State, action: Tensor) -> tuple[State, Rows, Tensor]:
        """The mean `[...]`, what was computed, and logarithms of its scales `[2, R]`."""
        # In here components come first and objects second, [C, M, ...]: loops then run over candidates.
        start, motion = (
            values.movedim(-1, 0).contiguous().unsqueeze(1) for values in endpoints(action, self.reach)
        )  # [2, 1, ...]
        length = motion.square().sum(0, keepdim=True).clamp_min(1e-8).sqrt()
        direction = motion / length

        ranks = action.dim() - 1
        x, y = components_first(state.centers[..., :2], ranks) - start
        place = _in_axes(x, y, *direction)  # [2, M, ...] along and across the push
        real = components_first(state.mask.unsqueeze(-1), ranks).squeeze(0).expand(place.shape[1:])
        near = near_pairs(place, real, self.neighbours)
        rows = self._rows(state.features, place, length.squeeze(0), real)

        # From here on objects are rows, [C, R].
        place, push = rows.of_objects(place), rows.of_objects(torch.cat((direction, length)))
        direction, length = push.split((2, 1))
        cosines, sines = multiples(*direction)  # [K, R]
        along, across = place.split(1)
        centers, values = rows.of_fields(state.centers), standard_values(rows.of_fields(state.features))
        shape, heights = values.split((OUTLINES * PER_OUTLINE, HEIGHTS))
        shape = turned(shape.unflatten(0, (OUTLINES, PER_OUTLINE)), cosines, sines)
        outline = torch.addcmul(self.typical.unsqueeze(1), self.spread.unsqueeze(1), shape[0])
        contact = self.contact(*place, outline, length.squeeze(0))
        table = on_table(centers)
        where = (along / PUSH_UNIT, across / DISPLACEMENT_UNIT, (along - length) / PUSH_UNIT, length / PUSH_UNIT)
        if self.equivariant:
            heights, fixed = turned_moments(heights, cosines[1], sines[1]), [table[2:]]
        else:
            fixed = [direction, table]
        each = torch.cat((*where, shape.flatten(0, 1), heights, *fixed, contact)).T  # [R, inputs]

        move, scale = self._motion(each, place, outline, rows, rows.pairs(near)).split((3, 1))
        change = self.shape_head(self.shape(each)).T.contiguous()
        shape_change, heights_change, shape_scale = change.split((OUTLINES * PER_OUTLINE, HEIGHTS, 1))
        forward, sideways, up = MAXIMUM_DISPLACEMENT * (move * (DISPLACEMENT_UNIT / MAXIMUM_DISPLACEMENT)).tanh()
        cosine, sine = direction
        moved = torch.stack((*_in_axes(forward, sideways, cosine, -sine), up))
        shape_change = turned(shape_change.unflatten(0, (OUTLINES, PER_OUTLINE)), cosines, -sines).flatten(0, 1)
        if self.equivariant:
            heights_change = turned_moments(heights_change, cosines[1], -sines[1], differences=True)
        changed = standard_features(values + torch.cat((shape_change, heights_change)))
        new_centers = rows.write(state.centers, centers + moved)
        mask = state.mask.expand(new_centers.shape[:-1])
        return State(new_centers, rows.write(state.features, changed), mask), rows, torch.cat((scale, shape_scale))

    def _rows(self, features: Tensor, place: Tensor, length: Tensor, real: Tensor) -> Rows:
        """The objects that are computed: `features: [..., M, 64]`, `place: [2, M, ...]`, `real: [M, ...]`."""
        counting = real
        if self.reach_margin is not None:
            with torch.no_grad():
                radius = components_first(mean_extent(features).unsqueeze(-1), real.dim() - 1).squeeze(0)
                along, across = place
                counting = real & in_reach(along, across, length, radius.expand(real.shape), self.reach_margin)
        return Rows(counting, every=shapes_are_fixed())

    def _motion(self, each: Tensor, place: Tensor, outline: Tensor, rows: Rows, pairs: Pairs | None) -> Tensor:
        """Motion in units of `DISPLACEMENT_UNIT` and the logarithm of its scale, `[4, R]`.

        each: `[R, inputs]`. place: `[2, R]`. outline: `[2 K + 1, R]`.
        """
        alone = self.object(each)
        motion = self.alone(alone).T.contiguous()
        relation = each.new_zeros(len(each), self.pair.out_features)
        if pairs is not None:
            measures = pair_contact(place, outline, *_aim(motion.detach()), pairs)
            hidden = self.pair(measures.T)
            hidden = hidden + rows.of_pairs(self.own, each, pairs.first) + rows.of_pairs(self.other, each, pairs.second)
            related = self.relation(hidden.relu_()) * pairs.real.unsqueeze(-1)
            relation = relation.index_add(0, pairs.first, related)
        after = self.head(self.second(torch.cat((alone, relation), -1))).T.contiguous()
        return torch.cat((after[:2] + motion, after[2:]))


def _in_axes(x: Tensor, y: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Vectors in axes that are turned by an angle: `[2, ...]`."""
    return torch.stack((torch.addcmul(x * cosine, y, sine), torch.addcmul(y * cosine, x, sine, value=-1)))


def _scales(logarithms: Tensor) -> Tensor:
    """`[2, ...]` -> scales of centres, in metres, and of features."""
    center, shape = logarithms.clamp(-6.0, 3.0).exp()
    return torch.stack(((0.2 * DISPLACEMENT_UNIT) * center, 0.05 * shape))


def _aim(motion: Tensor) -> tuple[Tensor, Tensor]:
    """Direction `[2, ...]` and length, in metres, of motions in units of `DISPLACEMENT_UNIT`."""
    length = motion.square().sum(0).clamp_min(1e-6).sqrt()
    return motion / length, DISPLACEMENT_UNIT * length
