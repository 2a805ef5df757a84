"""Which objects of which pushes f computes: all of them, or those that a push can reach."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from torch import Tensor, nn

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


def of_each_pair(near: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """`near: [M, M, ...]`, numbers `[P]` of objects -> `[P, ...]`."""
    return near.flatten(0, 1).index_select(0, len(near) * first + second)
