"""Estimates with 95 % intervals over episodes: windows of one episode overlap, so they are no independent observations.

Also ArviZ, which draws most figures of the report.
"""

from __future__ import annotations

import math
import warnings
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.stats import t as student
from torch import Tensor

LEVEL = 0.95
RESAMPLES = 1000  # of the episodes


class Interval(NamedTuple):
    """An estimate with the ends of its 95 % interval."""

    mean: float
    low: float
    high: float

    def percent(self, digits: int = 0) -> str:
        """A share, in per cent with so many digits; the ends within 0 and 1."""
        low, high = max(0.0, self.low), min(1.0, self.high)
        return f"{self.mean:.{digits}%} ({low:.{digits}%} to {high:.{digits}%})"

    def text(self, digits: int = 2) -> str:
        """A number, with so many digits."""
        return f"{self.mean:.{digits}f} ({self.low:.{digits}f} to {self.high:.{digits}f})"


UNKNOWN = Interval(math.nan, math.nan, math.nan)


def sums_by_episode(values: Tensor, episodes: Tensor) -> Tensor:
    """Sums of `values: [B]` over the windows of each of the G episodes, `episodes: [B]`: `[G]`, float64."""
    _, which = torch.unique(episodes, return_inverse=True)
    return torch.zeros(int(which.max()) + 1, dtype=torch.float64).index_add_(0, which, values.double())


def clustered_interval(mean: float, residuals: Tensor, episodes: Tensor) -> Interval:
    """A t interval around a mean, from the `residuals: [B]` of windows from `episodes: [B]` (Liang and Zeger, 1986).

    Of one episode it is infinitely wide.
    """
    sums = sums_by_episode(residuals, episodes)
    groups = len(sums)
    if groups < 2:
        return Interval(mean, -math.inf, math.inf)
    error = math.sqrt(sums.square().sum().item() * groups / (groups - 1)) / len(residuals)
    half = float(student.ppf(0.5 + LEVEL / 2, groups - 1)) * error
    return Interval(mean, mean - half, mean + half)


def mean_interval(values: Tensor, episodes: Tensor) -> Interval:
    """Mean of `values: [B]` over windows. Values that are NaN do not count; without any other all three are NaN."""
    known = ~values.isnan()
    values, episodes = values[known].double(), episodes[known]
    if len(values) == 0:
        return UNKNOWN
    mean = values.mean()
    return clustered_interval(mean.item(), values - mean, episodes)


def ratio_interval(part: Tensor, whole: Tensor, episodes: Tensor, *, seed: int = 0) -> Interval:
    """Sum of `part: [B]` over sum of `whole: [B]`, with the percentile bootstrap that resamples whole episodes."""
    sums = np.stack([sums_by_episode(values, episodes).numpy() for values in (part, whole)], -1)
    groups = len(sums)
    weights = np.random.default_rng(seed).multinomial(groups, np.full(groups, 1 / groups), size=RESAMPLES)
    with np.errstate(divide="ignore", invalid="ignore"):
        (estimate,), ratios = (parts / wholes for parts, wholes in (sums.sum(0)[:, None], (weights @ sums).T))
    ratios = ratios[np.isfinite(ratios)]
    if len(ratios) == 0:
        return Interval(float(estimate), math.nan, math.nan)
    low, high = np.quantile(ratios, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(float(estimate), float(low), float(high))


def rank(samples: Tensor, truth: Tensor) -> Tensor:
    """Where `truth: [...]` lies among `samples: [S, ...]`, in [0, 1]: uniform if both have one distribution.

    The rank is randomised within its step, so that uniform means exactly uniform for any S.
    """
    below, equal = (samples < truth).sum(0), (samples == truth).sum(0)
    return (below + torch.rand(truth.shape) * (equal + 1)) / (len(samples) + 1)


def covered(ranks: Tensor, level: float) -> Tensor:
    """Whether the central interval of a level holds the truth, by its rank: `[...]` float64, 0 or 1."""
    return ((ranks - 0.5).abs() <= level / 2).double()


def arviz() -> Any:
    """The package, imported where it is needed because that takes seconds, and without the news of its next version."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import arviz as package
    return package


def draw_ranks(panel: Any, ranks: Tensor, label: str, color: str, *, band: bool = False) -> None:
    """The empirical distribution of ranks `[N]` less the uniform one, by ArviZ; with its 95 % band for N ranks."""
    if len(ranks):
        arviz().plot_ecdf(
            ranks.numpy(),
            cdf=lambda values: np.clip(values, 0, 1),
            eval_points=np.linspace(0, 1, 101),
            difference=True,
            confidence_bands="pointwise" if band else False,
            ci_prob=LEVEL,
            plot_kwargs={"color": color, "label": label},
            plot_outline_kwargs={"visible": False},
            ax=panel,
        )
