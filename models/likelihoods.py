"""Likelihoods of f, h and g around their networks' means: Gaussian, with a scale per quantity (paper, section 3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from pyro import distributions
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from models.isotropic import Isotropic, IsotropicNormal, IsotropicStudentT, UprightStudentT
from models.state import State


class Scales:
    """Base class of likelihood scales: the likelihoods around the networks' means, from four standard deviations.

    center: standard deviation of an object's centre, in metres.
    feature: standard deviation of each number of a geometric feature, whose length is 1.
    start: standard deviation of a push's start, in normalised units (1 is half the reachable box).
    motion: standard deviation of a push's motion, in normalised units (1 is the longest push along an axis).
    """

    center: float | Tensor
    feature: float | Tensor
    start: float | Tensor
    motion: float | Tensor

    def centers(
        self, mean: State, mask: Tensor, *, event_dims: int = 1, predicted: Tensor | None = None
    ) -> TorchDistribution:
        """Observed centers around `mean`: event `[M, 3]`, or `[T, M, 3]` for `event_dims=2`.

        `mask: [..., M]`: objects that count; others (padding) do not contribute. `predicted: [..., M, 2]`, scales of
        centres (metres) and features that the network of the mean predicts; only `PredictedScales` reads them.
        """
        own = None if predicted is None else predicted[..., 0]
        return self._around_centers(mean.centers, own).mask(mask).to_event(event_dims)

    def features(
        self, mean: State, mask: Tensor, *, event_dims: int = 1, predicted: Tensor | None = None
    ) -> TorchDistribution:
        """Observed features around `mean`: event `[M, F]`, or `[T, M, F]` for `event_dims=2`."""
        own = None if predicted is None else predicted[..., 1]
        return self._around_features(mean.features, own).mask(mask).to_event(event_dims)

    def _around_centers(self, mean: Tensor, predicted: Tensor | None) -> Isotropic:
        return IsotropicNormal(mean, self.center)

    def _around_features(self, mean: Tensor, predicted: Tensor | None) -> Isotropic:
        return IsotropicNormal(mean, self.feature)

    def planar_errors(self, uniform: Tensor, predicted: Tensor | None = None) -> Tensor:
        """Errors of centres in x and y, metres, as in `centers`: the sample that `uniform: [..., M, 2]` determines.

        `predicted: [..., M]`, scales of centres. Of two numbers in [0, 1), the first is the probability of a smaller
        error, the second tells its direction (Box and Muller 1958; for Student's t, Bailey 1994).
        """
        radius, angle = self._radius(1.0 - uniform[..., 0], predicted), 2 * math.pi * uniform[..., 1]
        return torch.stack((radius * angle.cos(), radius * angle.sin()), -1)

    def _radius(self, exceeding: Tensor, predicted: Tensor | None) -> Tensor:
        """The error in the plane that a sample exceeds with probability `exceeding`."""
        return self.center * (-2.0 * exceeding.log()).sqrt()

    def actions(self, mean: Tensor) -> TorchDistribution:
        """Pushes around `mean: [..., T, 4]`: event `[T, 4]`."""
        # Filled where the means are: a copy from the CPU would let a GPU wait in every step.
        start, motion = (
            scale if isinstance(scale, Tensor) else mean.new_full((), scale) for scale in (self.start, self.motion)
        )
        return distributions.Normal(mean, torch.stack((start, start, motion, motion))).to_event(2)


@dataclass(frozen=True)
class LikelihoodScales(Scales):
    """Fixed standard deviations, instead of loss weights (the paper's choice and the default).

    For their units see `Scales`.
    """

    center: float = 0.01  # metres
    feature: float = 0.1  # of a vector of unit length
    start: float = 0.077  # normalised
    motion: float = 0.245  # normalised

    def __post_init__(self) -> None:
        """Raises `ValueError` for one that is not positive."""
        for name, value in vars(self).items():
            _check_positive(name, value)


@dataclass(frozen=True)
class PredictedScales(LikelihoodScales):
    """Scales of f that depend on state and push, predicted by its network, with heavy tails; fixed ones for h and g.

    f's likelihoods are Student's t around its means: most outcomes are nearly certain, and some objects topple or roll.

    degrees_of_freedom: of Student's t; fewer give heavier tails.
    height_ratio: scale of a centre's height over that of its place on the table.
    """

    degrees_of_freedom: float = 3.0
    height_ratio: float = 1.0

    def _around_centers(self, mean: Tensor, predicted: Tensor | None) -> Isotropic:
        if predicted is None:
            return super()._around_centers(mean, predicted)
        return UprightStudentT(self.degrees_of_freedom, mean, predicted, self.height_ratio)

    def _around_features(self, mean: Tensor, predicted: Tensor | None) -> Isotropic:
        if predicted is None:
            return super()._around_features(mean, predicted)
        return IsotropicStudentT(self.degrees_of_freedom, mean, predicted)

    def _radius(self, exceeding: Tensor, predicted: Tensor | None) -> Tensor:
        if predicted is None:
            return super()._radius(exceeding, predicted)
        freedom = self.degrees_of_freedom
        return predicted * (freedom * (exceeding ** (-2.0 / freedom) - 1.0)).sqrt()


class LearnedScales(Scales, nn.Module):
    """Learned standard deviations, shared by f and h, and by all windows. For their units see `Scales`."""

    def __init__(
        self, *, center: float = 0.01, feature: float = 0.1, start: float = 0.077, motion: float = 0.245
    ) -> None:
        """Initial values. Raises `ValueError` for one that is not positive."""
        super().__init__()
        for name, value in (("center", center), ("feature", feature), ("start", start), ("motion", motion)):
            _check_positive(name, value)
            self.register_parameter(f"log_{name}", nn.Parameter(torch.tensor(value).log()))

    def __getattr__(self, name: str) -> Any:
        if name in ("center", "feature", "start", "motion"):
            return self.get_parameter(f"log_{name}").exp()
        return super().__getattr__(name)


def _check_positive(name: str, value: float) -> None:
    if not 0 < value < float("inf"):
        raise ValueError(f"scales.{name} must be positive, not {value:g}")
