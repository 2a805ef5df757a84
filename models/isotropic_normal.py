"""A Gaussian with one standard deviation for all its components."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor


class IsotropicNormal(TorchDistribution):
    """N(loc, scale^2 I) for `loc: [..., D]`: batch `[...]`, event `[D]`.

    Equal to `Normal(loc, scale).to_event(1)`, with a third of its memory traffic: the scale is a number (or a scalar
    tensor, if it is learned), and weights the sum of squared errors.
    """

    arg_constraints: dict[str, Any] = {"loc": constraints.real_vector}
    support = constraints.real_vector
    has_rsample = True

    def __init__(self, loc: Tensor, scale: float | Tensor, validate_args: bool | None = None) -> None:
        """Raises `ValueError` for a scale that is not positive."""
        if not scale > 0:
            raise ValueError(f"scale must be positive, not {scale}")
        self.loc = loc
        self.scale = scale
        super().__init__(loc.shape[:-1], loc.shape[-1:], validate_args=validate_args)

    @property
    def mean(self) -> Tensor:
        return self.loc

    @property
    def variance(self) -> Tensor:
        return torch.ones_like(self.loc) * self.scale**2

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> IsotropicNormal:
        new = self._get_checked_instance(IsotropicNormal, _instance)
        new.loc = self.loc.expand(*batch_shape, *self.event_shape)
        new.scale = self.scale
        super(IsotropicNormal, new).__init__(torch.Size(batch_shape), self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    def rsample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        loc = self.loc.expand(*sample_shape, *self.loc.shape)
        return loc + self.scale * torch.randn_like(loc)

    def log_prob(self, value: Tensor) -> Tensor:
        if self._validate_args:
            self._validate_sample(value)
        squared_error = (value - self.loc).square().sum(-1)
        log_scale = self.scale.log() if isinstance(self.scale, Tensor) else math.log(self.scale)
        constant = self.loc.shape[-1] * (log_scale + 0.5 * math.log(2 * math.pi))
        return squared_error * (-0.5 / self.scale**2) - constant
