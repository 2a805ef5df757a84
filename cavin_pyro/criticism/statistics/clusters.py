"""Means and intervals of values whose windows come from the same episodes.

Windows of one episode overlap, so they are no independent observations. Every error here is over episodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

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


def sums_by_episode(values: Tensor, episodes: Tensor) -> Tensor:
    """Sums of `values: [B]` over the windows of each of the G episodes, `episodes: [B]`: `[G]`, float64."""
    _, which = torch.unique(episodes, return_inverse=True)
    return torch.zeros(int(which.max()) + 1, dtype=torch.float64).index_add_(0, which, values.double())


def mean_with_error(values: Tensor, episodes: Tensor) -> dict[str, float]:
    """Mean of `values: [B]` over windows, and its standard error clustered by `episodes: [B]` (Liang and Zeger, 1986).

    The error is 0 for a single episode, whose spread cannot be known.
    """
    mean = values.double().mean()
    return {"mean": mean.item(), "standard_error": clustered_error(values.double() - mean, episodes)}


def clustered_error(residuals: Tensor, episodes: Tensor) -> float:
    """Standard error of a mean, from the `residuals: [B]` of windows from `episodes: [B]`."""
    sums = sums_by_episode(residuals, episodes)
    groups = len(sums)
    if groups < 2:
        return 0.0
    return math.sqrt(sums.square().sum().item() * groups / (groups - 1)) / len(residuals)


def mean_interval(values: Tensor, episodes: Tensor) -> Interval:
    """Mean of `values: [B]` over windows, with a t interval over episodes; of one episode it is infinitely wide.

    Values that are NaN do not count; without any other all three are NaN.
    """
    known = ~values.isnan()
    values, episodes = values[known], episodes[known]
    if len(values) == 0:
        return Interval(math.nan, math.nan, math.nan)
    found = mean_with_error(values, episodes)
    groups = len(episodes.unique())
    half = float(student.ppf(0.5 + LEVEL / 2, groups - 1)) * found["standard_error"] if groups > 1 else math.inf
    return Interval(found["mean"], found["mean"] - half, found["mean"] + half)


def bootstrap_interval(statistic: Callable[[Tensor], Tensor], episodes: Tensor, *, seed: int = 0) -> Interval:
    """Any statistic of windows, with the percentile interval of a bootstrap that resamples whole episodes.

    Args:
        statistic: of weights `[R, B]`, how often each window counts in each of R resamples: `[R]`. episodes: `[B]`.
    """
    _, which = torch.unique(episodes, return_inverse=True)
    groups = int(which.max()) + 1
    counts = np.random.default_rng(seed).multinomial(groups, np.full(groups, 1 / groups), size=RESAMPLES)
    weights = torch.from_numpy(counts)[:, which].double()
    whole = statistic(torch.ones(1, len(episodes), dtype=torch.float64)).item()
    found = statistic(weights)
    finite = found[found.isfinite()].numpy()
    if len(finite) == 0:
        return Interval(whole, math.nan, math.nan)
    low, high = np.quantile(finite, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(whole, float(low), float(high))
