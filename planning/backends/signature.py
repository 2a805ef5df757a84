"""A function's arguments as flat tensors, and all but their contents as a signature."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor


def flatten(value: Any, tensors: list[Tensor], signature: list[Any]) -> None:
    """Append the tensors of a value to `tensors`, in order, and all but their contents to `signature`.

    A whole number becomes a tensor, so one version serves every segment of a plan.
    """
    if isinstance(value, tuple):
        signature.append(type(value))
        for part in value:
            flatten(part, tensors, signature)
        return
    if isinstance(value, int) and not isinstance(value, bool):
        value = torch.tensor(value)
    if isinstance(value, Tensor):
        tensors.append(value)
        value = value.dtype, value.shape, value.stride()
    signature.append(value)


def unflatten(value: Any, tensors: Iterator[Tensor]) -> Any:
    """The inverse of `flatten`, with other tensors; whole numbers return as the tensors that they became."""
    if isinstance(value, tuple):
        parts = [unflatten(part, tensors) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    counted = isinstance(value, int) and not isinstance(value, bool)
    return next(tensors) if counted or isinstance(value, Tensor) else value
