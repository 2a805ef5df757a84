"""Indexing and concatenating records: named tuples, nested or not, of tensors `[B, N, ...]` or None."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

Record = TypeVar("Record", bound=tuple)


def apply(record: Record, function: Callable[[Any], Any]) -> Record:
    """Apply one function to every field; None stays None. Plain tuples are allowed, too."""
    return _combine([record], lambda values: function(values[0]))


def take(record: Record, indices: Tensor) -> Record:
    """Take plans by index, per environment: fields `[B, N, ...]`, `indices: [B, n]` int64 -> `[B, n, ...]`."""
    environments = torch.arange(len(indices), device=indices.device).unsqueeze(-1)

    def chosen(field: Tensor) -> Tensor:  # one row at a time: faster than field[environments, indices]
        rows = (indices + environments * field.shape[1]).flatten()
        return field.flatten(0, 1).index_select(0, rows).unflatten(0, indices.shape)

    return apply(record, chosen)


def join(records: Sequence[Record], dimension: int = 1) -> Record:
    """Concatenate the plans of several records of one kind: `[B, N_1, ...], ... -> [B, N_1 + ..., ...]`.

    With `dimension=0` the environments: `[B_1, ...], ... -> [B_1 + ..., ...]`.
    """
    return _combine(records, lambda values: torch.cat(list(values), dim=dimension))


def where(chosen: Tensor, record: Any, other: Any) -> Any:
    """Fields `[B, ...]` of `record` in the environments `chosen: [B]` bool, of `other` elsewhere."""

    def field(values: Sequence[Tensor]) -> Tensor:
        first, second = values
        return torch.where(chosen.view(-1, *[1] * (first.ndim - 1)), first, second)

    return _combine([record, other], field)


def _combine(records: Sequence[Any], function: Callable[[Sequence[Any]], Any]) -> Any:
    """Apply one function to every field of several records; None where one of them has None."""
    first = records[0]
    if isinstance(first, tuple):
        parts = [_combine(values, function) for values in zip(*records, strict=True)]
        return type(first)(*parts) if hasattr(first, "_fields") else tuple(parts)
    return None if any(record is None for record in records) else function(records)
