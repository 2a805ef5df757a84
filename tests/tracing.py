"""What native code is made of, without a compiler."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn


class _Called(nn.Module):
    def __init__(self, function: Callable[..., Tensor]) -> None:
        super().__init__()
        self.function = function

    def forward(self, *values: Tensor) -> Tensor:
        return self.function(*values)


def traced(function: Callable[..., Tensor], *values: Tensor) -> torch.fx.GraphModule:
    """The operations that a compiler is given of `function`, to be called one at a time, and to be counted."""
    return torch.export.export(_Called(function), values, strict=False).module()
