"""Gaussian likelihoods with fixed scales: f, h and g around their networks' means (paper, section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

from pyro import distributions
from pyro.distributions import TorchDistribution
from torch import Tensor

from models.isotropic_normal import IsotropicNormal
from models.state import State


@dataclass(frozen=True)
class LikelihoodScales:
    """Standard deviations; they take the place of loss weights."""

    center: float = 0.01  # metres
    feature: float = 0.1  # of a vector of unit length
    start: float = 0.077  # normalised
    motion: float = 0.245  # normalised

    def centers(self, mean: State, mask: Tensor, *, event_dims: int = 1) -> TorchDistribution:
        """Observed centers around `mean`: event `[M, 3]`, or `[T, M, 3]` for `event_dims=2`.

        `mask: [..., M]`: objects that count; the others (padding) contribute nothing.
        """
        return _masked_normal(mean.centers, self.center, mask, event_dims)

    def features(self, mean: State, mask: Tensor, *, event_dims: int = 1) -> TorchDistribution:
        """Observed features around `mean`: event `[M, F]`, or `[T, M, F]` for `event_dims=2`."""
        return _masked_normal(mean.features, self.feature, mask, event_dims)

    def actions(self, mean: Tensor) -> TorchDistribution:
        """Pushes around `mean: [..., T, 4]`: event `[T, 4]`."""
        scale = mean.new_tensor((self.start, self.start, self.motion, self.motion))
        return distributions.Normal(mean, scale).to_event(2)


def _masked_normal(mean: Tensor, scale: float, mask: Tensor, event_dims: int) -> TorchDistribution:
    return IsotropicNormal(mean, scale).mask(mask).to_event(event_dims)
