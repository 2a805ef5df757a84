"""All objects of all pushes: shapes that follow from the arguments' shapes, as native code needs them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from models.networks.contact.rows import Pairs, Rows, components_first, of_each_pair


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
        # Counted where the objects are: numbers from the CPU would be a copy in every call, and CUDA graphs have none.
        number = torch.arange(objects * (objects - 1), device=self._counting.device)
        first, second = number // (objects - 1), number % (objects - 1)
        second = second + (second >= first)  # of the others in their order
        exchanged = second * (objects - 1) + first - (first > second).long()
        real = self._counting.index_select(0, second)
        return Pairs(first, second, exchanged, real if near is None else real & of_each_pair(near, first, second))

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
