"""Only the objects that a push can reach: shapes that follow from values, and less to compute."""

from __future__ import annotations

from functools import cache
from itertools import combinations
from math import prod

import torch
from torch import Tensor, nn
from torch.nn import functional

from models.networks.contact.rows import Pairs, Rows, of_each_pair


class ChosenRows(Rows):
    """The objects that count, numbered one by one; few others are computed, and not written.

    Numbers of rows and of pairs are rounded up, since libraries prepare matrix products for each new shape.
    """

    def __init__(self, counting: Tensor) -> None:
        """`counting: [M, ...]` bool."""
        objects, *pushes = self._all = (*counting.shape,)
        self._counting = counting.reshape(objects, -1)
        found = self._counting.flatten().nonzero().squeeze(1)
        self._count = len(found)
        self._found = found = _rounded_up(found)  # numbers of [M, ...]
        count = max(1, prod(pushes))
        self._pushes = found.remainder(count)
        self._places = torch.add(found.div(count, rounding_mode="floor"), self._pushes, alpha=objects)  # of [..., M]
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
            one_way, other_way = (of_each_pair(near, *order).flatten(1) for order in ((first, second), (second, first)))
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
@torch.inference_mode(False)  # kept for callers with and without gradients
def _unordered_pairs(objects: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Numbers of the first and the second object of all M (M - 1) / 2 pairs."""
    order = torch.tensor(list(combinations(range(objects), 2)), dtype=torch.int64, device=device)
    first, second = order.reshape(-1, 2).T.contiguous()
    return first, second


def _rounded_up(numbers: Tensor) -> Tensor:
    """`[R]` with zeros appended, by at most an eighth, or to 32: few lengths occur."""
    count = len(numbers)
    return functional.pad(numbers, (0, -count % 2 ** max(5, count.bit_length() - 4)))
