"""Student's t distribution with one scale for all components of a vector."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from pyro import distributions
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor


class IsotropicStudentT(TorchDistribution):
    """Multivariate t around `loc: [..., D]` with shape matrix scale^2 I, `scale: [...]`: batch `[...]`, event `[D]`.

    Equal to `pyro.distributions.MultivariateStudentT(df, loc, scale * eye(D))`, without its matrices. Its heavy tails
    suit pushes, most of whose outcomes are nearly certain, while some end with an object that rolls or topples.
    """

    arg_constraints: dict[str, Any] = {"loc": constraints.real_vector, "scale": constraints.positive}
    support = constraints.real_vector
    has_rsample = True

    def __init__(self, df: float, loc: Tensor, scale: Tensor, validate_args: bool | None = None) -> None:
        """Raises `ValueError` for degrees of freedom of 2 or less, which have no variance."""
        if not df > 2:
            raise ValueError(f"df must be more than 2, not {df:g}")
        self.df = df
        self.loc = loc
        self.scale = scale
        super().__init__(loc.shape[:-1], loc.shape[-1:], validate_args=validate_args)

    @property
    def mean(self) -> Tensor:
        return self.loc

    @property
    def variance(self) -> Tensor:
        return torch.ones_like(self.loc) * (self.scale.square() * (self.df / (self.df - 2))).unsqueeze(-1)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> IsotropicStudentT:
        new = self._get_checked_instance(IsotropicStudentT, _instance)
        new.df = self.df
        new.loc = self.loc.expand(*batch_shape, *self.event_shape)
        new.scale = self.scale.expand(*batch_shape)
        super(IsotropicStudentT, new).__init__(torch.Size(batch_shape), self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    def rsample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        loc = self.loc.expand(*sample_shape, *self.loc.shape)
        half = loc.new_full(loc.shape[:-1], self.df / 2)
        shrink = distributions.Gamma(half, half).sample()  # chi-squared over its degrees of freedom
        return loc + (self.scale / shrink.sqrt()).unsqueeze(-1) * torch.randn_like(loc)

    def log_prob(self, value: Tensor) -> Tensor:
        if self._validate_args:
            self._validate_sample(value)
        dimension, df = self.loc.shape[-1], self.df
        squared_error = (value - self.loc).square().sum(-1) / self.scale.square()
        constant = math.lgamma((df + dimension) / 2) - math.lgamma(df / 2) - dimension / 2 * math.log(math.pi * df)
        return constant - dimension * self.scale.log() - (df + dimension) / 2 * (squared_error / df).log1p()
