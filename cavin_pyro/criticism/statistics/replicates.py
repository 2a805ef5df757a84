"""Replicated datasets, their test statistics, and tail probabilities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.criticism.statistics.pushing import Statistic
from cavin_pyro.criticism.statistics.windows import generated, repeated
from guides.guide import Guide
from models.model import Model
from models.state import Window

QUANTILE = 0.95  # test statistic of continuous quantities, beside the mean


def replicate(
    model: Model,
    window: Window,
    statistics: Sequence[Statistic],
    *,
    replicates: int,
    guide: Guide | None = None,
    means: Sequence[str] | None = None,
) -> dict[str, Tensor]:
    """Each statistic of `replicates` (R) datasets generated for windows `[B]`: `[R, B]` or `[R, B, T]`.

    `guide` and `means` are those of `windows.generated`.
    """
    parts: dict[str, list[Tensor]] = {statistic.name: [] for statistic in statistics}
    for count, copies in repeated(window, replicates):
        outcome = generated(model, copies, guide=guide, means=means)
        for statistic in statistics:
            parts[statistic.name].append(statistic.function(outcome).unflatten(0, (count, -1)))
    return {name: torch.cat(values) for name, values in parts.items()}


def summaries(values: Tensor, statistic: Statistic) -> dict[str, NDArray[np.float64]]:
    """Of each of R datasets `values: [R, ...]`: mean and, where continuous, q95, without NaN. Each `[R]`."""
    flat = values.flatten(1).double()
    summary = {"mean": flat.nanmean(1)}
    if statistic.counts is None:
        summary[f"q{100 * QUANTILE:.0f}"] = flat.nanquantile(QUANTILE, 1)
    return {name: value.numpy() for name, value in summary.items()}


def compare(values: Tensor, real: Tensor, statistic: Statistic) -> dict[str, dict[str, float]]:
    """Test statistics of replicates `values: [R, ...]` against those of the real dataset `real: [...]`.

    Returns:
        Of each: mean over replicates, low and high ends of their central 95 % interval, and tail, the
        probability P(T(rep) >= T(obs)) with ties counted half. All NaN where a statistic exists nowhere.
    """
    target = summaries(real.unsqueeze(0), statistic)
    compared = {}
    for name, each in summaries(values, statistic).items():
        each, wanted = each[np.isfinite(each)], target[name][0]
        if len(each) == 0 or not np.isfinite(wanted):
            compared[name] = dict.fromkeys(("mean", "low", "high", "tail"), float("nan"))
            continue
        low, high = np.quantile(each, (0.025, 0.975))
        # Means of counts tie often: most of all where nothing of the kind happens, here and there.
        tail = (each > wanted).mean() + (each == wanted).mean() / 2
        compared[name] = {"mean": float(each.mean()), "low": float(low), "high": float(high), "tail": float(tail)}
    return compared
