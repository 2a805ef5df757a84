"""Distributions of vectors with one scale for all their components, or with another for the last."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from pyro import distributions
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor

Self = TypeVar("Self", bound="Isotropic")


class Isotropic(TorchDistribution):
    """Base class: around `loc: [..., D]`, batch `[...]`, event `[D]`; the scale is a number or a tensor `[...]`."""

    arg_constraints: dict[str, Any] = {"loc": constraints.real_vector}
    support = constraints.real_vector
    has_rsample = True

    def __init__(self, loc: Tensor, scale: float | Tensor, validate_args: bool | None = None) -> None:
        self.loc = loc
        self.scale = scale
        super().__init__(loc.shape[:-1], loc.shape[-1:], validate_args=validate_args)

    @property
    def mean(self) -> Tensor:
        return self.loc

    def expand(self: Self, batch_shape: Sequence[int], _instance: Any = None) -> Self:
        new: Self = self._get_checked_instance(type(self), _instance)
        new.loc = self.loc.expand(*batch_shape, *self.event_shape)
        scale = self.scale
        new.scale = scale.expand(*batch_shape) if isinstance(scale, Tensor) and scale.dim() else scale
        super(Isotropic, new).__init__(torch.Size(batch_shape), self.event_shape, validate_args=False)
        new._validate_args = self._validate_args
        return new

    def _squared_error(self, value: Tensor) -> Tensor:
        if self._validate_args:
            self._validate_sample(value)
        return (value - self.loc).square().sum(-1)


class IsotropicNormal(Isotropic):
    """N(loc, scale^2 I), with a number or a scalar tensor (if it is learned) as scale.

    Equal to `Normal(loc, scale).to_event(1)`, with a third of its memory traffic: the scale weights the sum of squared
    errors.
    """

    def __init__(self, loc: Tensor, scale: float | Tensor, validate_args: bool | None = None) -> None:
        """Raises `ValueError` for a scale that is not positive."""
        if not scale > 0:
            raise ValueError(f"scale must be positive, not {scale}")
        super().__init__(loc, scale, validate_args=validate_args)

    @property
    def variance(self) -> Tensor:
        return torch.ones_like(self.loc) * self.scale**2

    def rsample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        loc = self.loc.expand(*sample_shape, *self.loc.shape)
        return loc + self.scale * torch.randn_like(loc)

    def log_prob(self, value: Tensor) -> Tensor:
        squared_error = self._squared_error(value)
        log_scale = self.scale.log() if isinstance(self.scale, Tensor) else math.log(self.scale)
        constant = self.loc.shape[-1] * (log_scale + 0.5 * math.log(2 * math.pi))
        return squared_error * (-0.5 / self.scale**2) - constant


class IsotropicStudentT(Isotropic):
    """Multivariate t with shape matrix scale^2 I, `scale: [...]`.

    Equal to `pyro.distributions.MultivariateStudentT(df, loc, scale * eye(D))`, without its matrices. Its heavy tails
    suit pushes, most of whose outcomes are nearly certain, while some end with an object that rolls or topples.
    """

    scale: Tensor

    def __init__(self, df: float, loc: Tensor, scale: Tensor, validate_args: bool | None = None) -> None:
        """Raises `ValueError` for degrees of freedom of 2 or less, which have no variance."""
        if not df > 2:
            raise ValueError(f"df must be more than 2, not {df:g}")
        self.df = df
        super().__init__(loc, scale, validate_args=validate_args)

    @property
    def variance(self) -> Tensor:
        return torch.ones_like(self.loc) * (self.scale.square() * (self.df / (self.df - 2))).unsqueeze(-1)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> IsotropicStudentT:
        new = super().expand(batch_shape, _instance)
        new.df = self.df
        return new

    def rsample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        loc = self.loc.expand(*sample_shape, *self.loc.shape)
        half = loc.new_full(loc.shape[:-1], self.df / 2)
        shrink = distributions.Gamma(half, half).sample()  # chi-squared over its degrees of freedom
        return loc + (self.scale / shrink.sqrt()).unsqueeze(-1) * torch.randn_like(loc)

    def log_prob(self, value: Tensor) -> Tensor:
        dimension, df = self.loc.shape[-1], self.df
        squared_error = self._squared_error(value) / self.scale.square()
        constant = math.lgamma((df + dimension) / 2) - math.lgamma(df / 2) - dimension / 2 * math.log(math.pi * df)
        return constant - dimension * self.scale.log() - (df + dimension) / 2 * (squared_error / df).log1p()


class UprightStudentT(IsotropicStudentT):
    """The same for positions (x, y, z), whose height z has a scale of its own: `ratio` times that of x and y.

    A push along the table hardly changes heights; one scale for all three would be too narrow for x and y.
    """

    def __init__(self, df: float, loc: Tensor, scale: Tensor, ratio: float, validate_args: bool | None = None) -> None:
        """Raises `ValueError` for a ratio that is not positive, and as `IsotropicStudentT`."""
        if not 0 < ratio < math.inf:
            raise ValueError(f"ratio must be positive, not {ratio:g}")
        self.ratio = ratio
        super().__init__(df, loc, scale, validate_args=validate_args)

    @property
    def variance(self) -> Tensor:
        return super().variance * self._ratios().square()

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> UprightStudentT:
        new = super().expand(batch_shape, _instance)
        assert isinstance(new, UprightStudentT)
        new.ratio = self.ratio
        return new

    def rsample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        return self.loc + (super().rsample(sample_shape) - self.loc) * self._ratios()

    def log_prob(self, value: Tensor) -> Tensor:
        return super().log_prob(value) - math.log(self.ratio)

    def _squared_error(self, value: Tensor) -> Tensor:
        if self._validate_args:
            self._validate_sample(value)
        x, y, z = (value - self.loc).square().unbind(-1)
        return x + y + z * self.ratio**-2

    def _ratios(self) -> Tensor:
        return self.loc.new_tensor((1.0, 1.0, self.ratio))
