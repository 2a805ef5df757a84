"""Likelihoods of f, h and g around their networks' means: Gaussian, with a scale per quantity (paper, section 3.3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, get_type_hints

import torch
from pyro import distributions
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor

from cavin_pyro.models.checks import check_kinds, check_number
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State

Self = TypeVar("Self", bound="Isotropic")


class Scales:
    """Base class of likelihood scales: the likelihoods around the networks' means, from standard deviations.

    space: of the world. center: of a position, in the world's unit. feature: of each number of a feature. action: of
    the numbers of each part of an action, normalised.
    """

    space: Space
    center: float | Tensor
    feature: float | Tensor
    action: Sequence[float | Tensor]

    def centers(
        self, mean: State, mask: Tensor, *, event_dims: int = 1, predicted: Tensor | None = None
    ) -> TorchDistribution:
        """Observed centers around `mean`: event `[M, P]`, or `[T, M, P]` for `event_dims=2`.

        `mask: [..., M]`: objects that count; others (padding) do not contribute. `predicted: [..., M, 2]`, scales of
        centres and features that the network of the mean predicts; only `PredictedScales` reads them.
        """
        scale = None if predicted is None else predicted[..., 0]
        return self._around(mean.centers, self.center, scale, of_centers=True).mask(mask).to_event(event_dims)

    def features(
        self, mean: State, mask: Tensor, *, event_dims: int = 1, predicted: Tensor | None = None
    ) -> TorchDistribution:
        """Observed features around `mean`: event `[M, F]`, or `[T, M, F]` for `event_dims=2`."""
        scale = None if predicted is None else predicted[..., 1]
        return self._around(mean.features, self.feature, scale).mask(mask).to_event(event_dims)

    def _around(
        self, mean: Tensor, scale: float | Tensor, predicted: Tensor | None, *, of_centers: bool = False
    ) -> Isotropic:
        return IsotropicNormal(mean, scale)

    def actions(self, mean: Tensor) -> TorchDistribution:
        """Actions around `mean: [..., T, A]`: event `[T, A]`."""
        # Filled where the means are: a copy from the CPU would let a GPU wait in every step.
        parts = [scale if isinstance(scale, Tensor) else mean.new_full((), scale) for scale in self.action]
        sizes = zip(parts, self.space.action_sizes, strict=True)
        return distributions.Normal(mean, torch.stack([part for part, size in sizes for _ in range(size)])).to_event(2)


@dataclass(frozen=True)
class LikelihoodScales(Scales):
    """Fixed standard deviations, instead of loss weights (the paper's choice and the default).

    For their units see `Scales`; None takes the space's. Raises `ValueError` for one that is not positive.
    """

    space: Space
    center: float | None = None  # type: ignore[assignment]
    feature: float | None = None  # type: ignore[assignment]
    action: Sequence[float] | None = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        check_kinds(vars(self), get_type_hints(type(self)))
        space, parts = self.space, tuple(self.space.action_scales if self.action is None else self.action)
        object.__setattr__(self, "action", parts)
        if len(parts) != len(space.action_sizes):
            raise ValueError(f"scales.action needs {len(space.action_sizes)} numbers, not {len(parts)}")
        for name, usual in (("center", space.center_scale), ("feature", space.feature_scale)):
            object.__setattr__(self, name, usual if getattr(self, name) is None else getattr(self, name))
        for name, value in (("center", self.center), ("feature", self.feature), *[("action", part) for part in parts]):
            check_number(f"scales.{name}", value, 1e-12, 1e12)  # beyond, its square or a density overflows


@dataclass(frozen=True)
class PredictedScales(LikelihoodScales):
    """Scales of f that depend on state and action, predicted by its network, with heavy tails; fixed ones for h and g.

    f's likelihoods are Student's t around its means: most outcomes are nearly certain, and a few are not.

    degrees_of_freedom: of Student's t; fewer give heavier tails.
    height_ratio: scale of a centre's last number, its height, over that of the others.
    """

    degrees_of_freedom: float = 3.0
    height_ratio: float = 1.0

    def _around(
        self, mean: Tensor, scale: float | Tensor, predicted: Tensor | None, *, of_centers: bool = False
    ) -> Isotropic:
        if predicted is None:
            return super()._around(mean, scale, predicted)
        return IsotropicStudentT(self.degrees_of_freedom, mean, predicted, self.height_ratio if of_centers else None)


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
    """Multivariate t with shape matrix scale^2 I, `scale: [...]`; for positions, the height's with a `ratio`.

    Equal to `pyro.distributions.MultivariateStudentT(df, loc, scale * eye(D))`, without its matrices. Its heavy tails
    suit outcomes most of which are nearly certain, while some end with an object that rolls or topples. With a `ratio`
    the last of three components, z, has that times the scale of x and y: what moves along a plane hardly changes its
    height, and one scale for all three would be too narrow for x and y.
    """

    scale: Tensor

    def __init__(
        self, df: float, loc: Tensor, scale: Tensor, ratio: float | None = None, validate_args: bool | None = None
    ) -> None:
        """Raises `ValueError` for degrees of freedom of 2 or less, which have no variance, or a ratio of 0 or less."""
        if not df > 2:
            raise ValueError(f"df must be more than 2, not {df:g}")
        check_number("ratio", 1 if ratio is None else ratio, positive=True)
        self.df, self.ratio = df, ratio
        super().__init__(loc, scale, validate_args=validate_args)

    @property
    def variance(self) -> Tensor:
        same = torch.ones_like(self.loc) * (self.scale.square() * (self.df / (self.df - 2))).unsqueeze(-1)
        return same if self.ratio is None else same * self.loc.new_tensor((1.0, 1.0, self.ratio**2))

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> IsotropicStudentT:
        new = super().expand(batch_shape, _instance)
        new.df, new.ratio = self.df, self.ratio
        return new

    def rsample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        loc = self.loc.expand(*sample_shape, *self.loc.shape)
        half = loc.new_full(loc.shape[:-1], self.df / 2)
        shrink = distributions.Gamma(half, half).sample()  # chi-squared over its degrees of freedom
        sampled = loc + (self.scale / shrink.sqrt()).unsqueeze(-1) * torch.randn_like(loc)
        if self.ratio is None:
            return sampled
        return self.loc + (sampled - self.loc) * self.loc.new_tensor((1.0, 1.0, self.ratio))

    def log_prob(self, value: Tensor) -> Tensor:
        dimension, df = self.loc.shape[-1], self.df
        squared_error = self._squared_error(value) / self.scale.square()
        constant = math.lgamma((df + dimension) / 2) - math.lgamma(df / 2) - dimension / 2 * math.log(math.pi * df)
        density = constant - dimension * self.scale.log() - (df + dimension) / 2 * (squared_error / df).log1p()
        return density if self.ratio is None else density - math.log(self.ratio)

    def _squared_error(self, value: Tensor) -> Tensor:
        if self.ratio is None:
            return super()._squared_error(value)
        if self._validate_args:
            self._validate_sample(value)
        x, y, z = (value - self.loc).square().unbind(-1)
        return x + y + z * self.ratio**-2
