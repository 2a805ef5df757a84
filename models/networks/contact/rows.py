"""Which objects of which pushes f computes: all of them, or those that a push can reach."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cache
from itertools import combinations, permutations
from math import prod
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.networks.neighbours import nearest_pairs


class Pairs(NamedTuple):
    """Ordered pairs of rows, each an object and another one; the other way round is a pair as well.

    Tensors of pairs are `[C, P, ...]`, in which `...` is empty for rows that are numbered one by one.
    """

    first: Tensor  # [P] int64, number of the object, along dimension 1 of tensors of rows
    second: Tensor  # [P] of the other one
    exchanged: Tensor  # [P] number of the pair the other way round
    real: Tensor  # [P, ...] bool, whether the other one counts


class Rows(ABC):
    """Objects of a batch of pushes `[M, ...]`, as tensors of rows `[C, R, ...]`, components first.

    Attributes:
        shape: of rows, without their components.
    """

    shape: tuple[int, ...]

    @abstractmethod
    def of_objects(self, values: Tensor) -> Tensor:
        """`[C, M, ...]`, a number of objects, or of pushes with M = 1 -> rows, or what broadcasts to rows."""

    @abstractmethod
    def of_fields(self, values: Tensor) -> Tensor:
        """A field of a state, `[..., M, C]`, whose leading dimensions broadcast to the batch's -> rows."""

    @abstractmethod
    def write(self, values: Tensor, changed: Tensor) -> Tensor:
        """`values: [..., M, C]` (as above) with `changed` rows in their places: `[..., M, C]`, contiguous."""

    @abstractmethod
    def pairs(self, near: Tensor | None) -> Pairs | None:
        """Pairs of objects of the same push, None if there are none; `near: [M, M, ...]` bool, of those that count."""

    @abstractmethod
    def to_pairs(self, values: Tensor, pairs: Pairs) -> tuple[Tensor, Tensor]:
        """The first and the second of each pair: `[C, R, ...]` -> `[C, P, ...]`, twice."""

    @abstractmethod
    def of_pairs(self, layer: nn.Module, values: Tensor, which: Tensor) -> Tensor:
        """A layer of the first or second of each pair: matrix `[prod(R, ...), W]` -> `[prod(P, ...), W']`."""

    @abstractmethod
    def sum_of_pairs(self, values: Tensor, pairs: Pairs) -> Tensor:
        """Sum over others: rows of a matrix, `[prod(P, ...), W]` -> `[prod(R, ...), W]`."""


class EveryRow(Rows):
    """All objects of all pushes; those that do not count are computed and not written.

    The shapes of all tensors follow from the shapes of the arguments, as native code needs it.
    """

    def __init__(self, counting: Tensor) -> None:
        """`counting: [M, ...]` bool."""
        self._counting = counting
        self.shape = (*counting.shape,)

    def of_objects(self, values: Tensor) -> Tensor:
        """See `Rows`."""
        return values

    def of_fields(self, values: Tensor) -> Tensor:
        """See `Rows`."""
        return components_first(values, len(self.shape) - 1)

    def write(self, values: Tensor, changed: Tensor) -> Tensor:
        """See `Rows`."""
        changed = torch.where(self._counting, changed, self.of_fields(values))
        # Two copies are faster than one.
        return changed.flatten(1).T.contiguous().unflatten(0, changed.shape[1:]).movedim(0, -2).contiguous()

    def pairs(self, near: Tensor | None) -> Pairs | None:
        """See `Rows`."""
        objects = self.shape[0]
        if objects < 2:
            return None
        order = list(permutations(range(objects), 2))
        exchanged = [order.index((j, i)) for i, j in order]
        first, second, exchanged = torch.tensor([*zip(*order, strict=True), exchanged], device=self._counting.device)
        real = self._counting.index_select(0, second)
        return Pairs(first, second, exchanged, real if near is None else real & _of_pairs(near, first, second))

    def to_pairs(self, values: Tensor, pairs: Pairs) -> tuple[Tensor, Tensor]:
        """See `Rows`."""
        return values.index_select(1, pairs.first), values.index_select(1, pairs.second)

    def of_pairs(self, layer: nn.Module, values: Tensor, which: Tensor) -> Tensor:
        """See `Rows`."""
        return layer(values).unflatten(0, (self.shape[0], -1)).index_select(0, which).flatten(0, 1)

    def sum_of_pairs(self, values: Tensor, pairs: Pairs) -> Tensor:
        """See `Rows`."""
        objects = self.shape[0]
        return values.unflatten(0, (objects, objects - 1, -1)).sum(1).flatten(0, 1)


class ChosenRows(Rows):
    """The objects that count, numbered one by one; few others are computed, and not written.

    Numbers of rows and of pairs are rounded up, since libraries prepare matrix products for each new shape.
    """

    def __init__(self, counting: Tensor) -> None:
        """`counting: [M, ...]` bool."""
        objects, *pushes = self._all = (*counting.shape,)
        self._counting = counting.flatten(1)
        found = self._counting.flatten().nonzero().squeeze(1)
        self._count = len(found)
        found = _rounded_up(found)
        self._pushes = found.remainder(max(1, prod(pushes)))
        self._places = torch.add(found.div(max(1, prod(pushes)), rounding_mode="floor"), self._pushes, alpha=objects)
        self._found = found
        self.shape = (*found.shape,)

    def of_objects(self, values: Tensor) -> Tensor:
        """See `Rows`."""
        one = values.shape[1] == 1
        values = values.expand(-1, -1, *self._all[1:]).flatten(1)
        return values.index_select(1, self._pushes if one else self._found)

    def of_fields(self, values: Tensor) -> Tensor:
        """See `Rows`."""
        return self._matrix(values).index_select(0, self._places).T.contiguous()

    def write(self, values: Tensor, changed: Tensor) -> Tensor:
        """See `Rows`."""
        values, places = self._matrix(values), self._places[: self._count]
        changed = changed[:, : self._count].T.to(values.dtype)
        objects, *pushes = self._all
        return values.index_copy(0, places, changed).view(*pushes, objects, -1)

    def pairs(self, near: Tensor | None) -> Pairs | None:
        """See `Rows`."""
        objects, pushes = self._counting.shape
        first, second = _unordered_pairs(objects, self._found.device)
        both = self._counting.index_select(0, first) & self._counting.index_select(0, second)
        if near is not None:
            one_way, other_way = (_of_pairs(near, *order).flatten(1) for order in ((first, second), (second, first)))
            both &= one_way | other_way
        found = both.flatten().nonzero().squeeze(1)
        count = len(found)
        if not count:
            return None
        found = _rounded_up(found)
        which, push = found.div(pushes, rounding_mode="floor"), found.remainder(pushes)
        row = (self._counting.flatten().cumsum(0) - 1).clamp_min_(0)
        ones, others = (row.index_select(0, torch.add(push, each[which], alpha=pushes)) for each in (first, second))
        numbers = torch.arange(2 * len(found), device=found.device)
        real = numbers.remainder(len(found)) < count
        if near is not None:
            real &= torch.cat((one_way.flatten()[found], other_way.flatten()[found]))
        return Pairs(torch.cat((ones, others)), torch.cat((others, ones)), numbers.roll(len(found)), real)

    def to_pairs(self, values: Tensor, pairs: Pairs) -> tuple[Tensor, Tensor]:
        """See `Rows`."""
        values = values.T.contiguous()  # whole rows of a matrix are copied faster than columns
        first, second = (values.index_select(0, which).T.contiguous() for which in (pairs.first, pairs.second))
        return first, second

    def of_pairs(self, layer: nn.Module, values: Tensor, which: Tensor) -> Tensor:
        """See `Rows`."""
        return layer(values.index_select(0, which))  # there are fewer pairs than rows

    def sum_of_pairs(self, values: Tensor, pairs: Pairs) -> Tensor:
        """See `Rows`."""
        return values.new_zeros(*self.shape, values.shape[-1]).index_add(0, pairs.first, values)

    def _matrix(self, values: Tensor) -> Tensor:
        """A row for each object of each push, objects last."""
        objects, *pushes = self._all
        return values.expand(*pushes, objects, values.shape[-1]).flatten(0, -2)


@cache
def _unordered_pairs(objects: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Numbers of the first and the second object of all M (M - 1) / 2 pairs."""
    order = torch.tensor(list(combinations(range(objects), 2)), dtype=torch.int64, device=device)
    first, second = order.reshape(-1, 2).T.contiguous()
    return first, second


def _rounded_up(numbers: Tensor) -> Tensor:
    """`[R]` with zeros appended, by at most an eighth, or to 32: few lengths occur."""
    count = len(numbers)
    return functional.pad(numbers, (0, -count % 2 ** max(5, count.bit_length() - 4)))


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


def _of_pairs(near: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """`near: [M, M, ...]`, numbers `[P]` of objects -> `[P, ...]`."""
    return near.flatten(0, 1).index_select(0, len(near) * first + second)
