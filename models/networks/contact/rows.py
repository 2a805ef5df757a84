"""Which objects of which pushes f computes: those that a push can reach, or all of them where shapes must be fixed."""

from __future__ import annotations

from math import prod
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from cavin_pyro.models.networks.layers import nearest_pairs


class Pairs(NamedTuple):
    """Ordered pairs of rows, each an object and another one of the same push; the other way round is a pair as well."""

    first: Tensor  # [P] number of the object's row
    second: Tensor  # [P] of the other one's
    exchanged: Tensor  # [P] number of the pair the other way round
    real: Tensor  # [P] bool, whether the other one counts


class Rows:
    """Objects of a batch of pushes `[M, ...]`, as rows `[C, R]`, components first.

    The objects that count are numbered one by one; few others are computed, and none is written. Numbers of rows and of
    pairs are rounded up, since libraries prepare matrix products for each new shape. With `every` object a row, the
    shapes of all tensors follow from the shapes of the arguments, as graphs need it, with less speed.
    """

    def __init__(self, counting: Tensor, *, every: bool = False) -> None:
        """`counting: [M, ...]` bool."""
        objects, *pushes = self._all = (*counting.shape,)
        self._counting, self._every = counting.reshape(objects, -1), every
        found, self._count = self._numbers(self._counting)
        self._found = found  # numbers of [M, ...]
        count = max(1, prod(pushes))
        self._pushes = found.remainder(count)
        self._places = torch.add(found.div(count, rounding_mode="floor"), self._pushes, alpha=objects)  # of [..., M]

    def of_objects(self, values: Tensor) -> Tensor:
        """`[C, M, ...]`, a number of objects, or of pushes with M = 1 -> rows."""
        one = values.shape[1] == 1
        values = values.expand(-1, -1, *self._all[1:]).flatten(1)
        return values.index_select(1, self._pushes if one else self._found)

    def of_fields(self, values: Tensor) -> Tensor:
        """A field of a state, `[..., M, C]`, whose leading dimensions broadcast to the batch's -> rows."""
        return self._matrix(values).index_select(0, self._places).T.contiguous()

    def write(self, values: Tensor, changed: Tensor) -> Tensor:
        """`values: [..., M, C]` (as above) with `changed` rows in their places: `[..., M, C]`, contiguous."""
        values, places = self._matrix(values), self._places[: self._count]
        changed = changed[:, : self._count].T.to(values.dtype)
        if self._every:
            counting = self._counting.flatten().unsqueeze(1)
            changed = torch.where(counting, changed, values.index_select(0, places))
        objects, *pushes = self._all
        return values.index_copy(0, places, changed).view(*pushes, objects, -1)

    def pairs(self, near: Tensor | None) -> Pairs | None:
        """Pairs of objects of the same push, None if there are none; `near: [M, M, ...]` bool, of those that count."""
        objects, pushes = self._counting.shape
        first, second = torch.triu_indices(objects, objects, 1, device=self._found.device)
        firsts, seconds = self._counting.index_select(0, first), self._counting.index_select(0, second)
        both, ways = firsts & seconds, [seconds, firsts]  # whether the other one counts, one way and the other
        if near is not None:
            orders = (first, second), (second, first)
            ways = [way & near[order].view(len(first), -1) for way, order in zip(ways, orders, strict=True)]
            both &= ways[0] | ways[1]
        found, count = self._numbers(both)
        if not count:
            return None
        which, push = found.div(pushes, rounding_mode="floor"), found.remainder(pushes)
        ones, others = (torch.add(push, each[which], alpha=pushes) for each in (first, second))
        if not self._every:
            row = (self._counting.flatten().cumsum(0) - 1).clamp_min_(0)
            ones, others = row.index_select(0, ones), row.index_select(0, others)
        number = torch.arange(2 * len(found), device=found.device)
        real = number.remainder(len(found)) < count
        if self._every or near is not None:
            real &= torch.cat([way.flatten()[found] for way in ways])
        return Pairs(torch.cat((ones, others)), torch.cat((others, ones)), number.roll(len(found)), real)

    def of_pairs(self, layer: nn.Module, values: Tensor, which: Tensor) -> Tensor:
        """A layer of the first or second of each pair: a matrix `[R, W]` -> `[P, W']`."""
        if self._every:  # there are fewer rows than pairs
            return layer(values).index_select(0, which)
        return layer(values.index_select(0, which))

    def _numbers(self, chosen: Tensor) -> tuple[Tensor, int]:
        """Numbers of the chosen, with zeros appended by at most an eighth, or to 32 (few lengths occur); how many."""
        if self._every:
            return torch.arange(chosen.numel(), device=chosen.device), chosen.numel()
        found = chosen.flatten().nonzero().squeeze(1)
        count = len(found)
        return functional.pad(found, (0, -count % 2 ** max(5, count.bit_length() - 4))), count

    def _matrix(self, values: Tensor) -> Tensor:
        """A row for each object of each push, objects last."""
        objects, *pushes = self._all
        return values.expand(*pushes, objects, values.shape[-1]).flatten(0, -2)


def components_first(values: Tensor, ranks: int) -> Tensor:
    """`[..., M, C]` -> `[C, M, ...]`, with at least as many leading dimensions as `ranks`."""
    values = values.movedim((-1, -2), (0, 1)).contiguous()
    return values.reshape(values.shape[:2] + (ranks + 2 - values.dim()) * (1,) + values.shape[2:])


def near_pairs(place: Tensor, real: Tensor, most: int | None) -> Tensor | None:
    """Whether another object is among the `most` nearest: `[M, M, ...]` bool; None where all others are.

    `place: [2, M, ...]` metres, `real: [M, ...]` bool.
    """
    if most is None or len(real) - 1 <= most:
        return None
    return nearest_pairs(place.movedim((0, 1), (-1, -2)), real.movedim(0, -1), most).movedim((-2, -1), (0, 1))
