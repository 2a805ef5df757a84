"""Where pushed objects meet each other, from their outlines: geometry without learned numbers."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn

from models.networks.contact.tool import DISPLACEMENT_UNIT
from models.networks.outline import HARMONICS, multiples, support

PAIR_MEASURES = 12


class ObjectContact(nn.Module):
    """Pairs of objects, of which the tool would carry each along its aim, a direction of its own.

    The way until a carried object meets another is their distance along the aim, less how far both reach in that
    direction. It passes if the gap across the aim is positive.
    """

    turns: Tensor  # [3, 2, K]: cosines and sines of multiples of a half, a left and a right turn

    def __init__(self) -> None:
        super().__init__()
        quarters = torch.arange(1, HARMONICS + 1) * (torch.pi / 2)
        turns = torch.stack([torch.stack(((n * quarters).cos(), (n * quarters).sin())) for n in (2, 1, 3)])
        self.register_buffer("turns", turns.round(), persistent=False)

    def forward(self, place: Tensor, outlines: Tensor, aim: Tensor, carried: Tensor) -> Iterator[Tensor]:
        """Measures of each object i and another j = (i - shift) mod M, for every shift from 1 to M - 1.

        Args:
            place: `[..., M, 2]` metres, centres in axes of the push. outlines: `[..., M, 2 K + 1]`, in the same axes.
            aim: `[..., M, 2]` unit vectors. carried: `[..., M]` metres along the aim, 0 without contact.

        Yields:
            `[..., M, PAIR_MEASURES]` in units of `DISPLACEMENT_UNIT`: where i is, seen from j, and where j would push
            it; if j were carried: the way until it meets i, the gap between them across the aim, how far it would push
            i; the same three for i and j exchanged; how far both are carried.
        """
        cosines, sines = multiples(*aim.unbind(-1))  # [..., M, K]
        back, left, right = (_turned(cosines, sines, turn) for turn in self.turns)
        ahead, leftwards, rightwards = (support(outlines, *one) for one in ((cosines, sines), left, right))
        for shift in range(1, place.shape[-2]):

            def other(value: Tensor, shift: int = shift) -> Tensor:
                return value.roll(shift, -1)

            def others(values: Tensor, shift: int = shift) -> Tensor:
                return values.roll(shift, -2)

            theirs, their_aim, their_way = others(outlines), others(aim), other(carried)
            offset = place - others(place)  # from j to i
            aside = _across(their_aim, offset)
            meet = (offset * their_aim).sum(-1) - other(ahead) - support(outlines, *map(others, back))
            gap = torch.maximum(
                aside - other(leftwards) - support(outlines, *map(others, right)),
                -aside - other(rightwards) - support(outlines, *map(others, left)),
            )
            push = _push(their_way, meet, gap)
            aside = -_across(aim, offset)
            own_meet = -(offset * aim).sum(-1) - ahead - support(theirs, *back)
            own_gap = torch.maximum(
                aside - leftwards - support(theirs, *right), -aside - rightwards - support(theirs, *left)
            )
            own_push = _push(carried, own_meet, own_gap)
            pushed = push.unsqueeze(-1) * their_aim
            measures = torch.stack((meet, gap, push, own_meet, own_gap, own_push, carried, their_way), -1)
            yield torch.cat((offset, pushed, measures), -1) / DISPLACEMENT_UNIT


def _turned(cosines: Tensor, sines: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
    """Multiples of an angle after a turn, whose own multiples are `turn: [2, K]`."""
    return cosines * turn[0] - sines * turn[1], sines * turn[0] + cosines * turn[1]


def _across(direction: Tensor, offset: Tensor) -> Tensor:
    """Component of `offset` to the left of a direction, `[..., 2]` each -> `[...]`."""
    return direction[..., 0] * offset[..., 1] - direction[..., 1] * offset[..., 0]


def _push(way: Tensor, meet: Tensor, gap: Tensor) -> Tensor:
    """How far an object that is carried `way` pushes another that it meets after `meet`; 0 if it passes."""
    return (way - meet.clamp_min(0.0)).clamp_min(0.0) * ((gap < 0) & (meet > -0.05))
