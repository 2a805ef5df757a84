"""Calibration: whether events that are given the probability p happen with the frequency p.

An episode has one outcome and many plans. Its plans share its weight, so every episode counts the same, and intervals
resample episodes, not plans.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MOST_BINS = 10
EPISODES_PER_BIN = 25  # worth of weight, at least
RESAMPLES = 2000
LEVEL = 0.95

Array = NDArray[np.float64]


class Interval(NamedTuple):
    """An estimate with its bounds at 95 %, which are too narrow if all episodes ended alike."""

    value: float
    low: float
    high: float


class Calibration(NamedTuple):
    """How predictions and outcomes agree.

    error: expected calibration error: the mean over bins of the distance between the mean prediction and the frequency.
        Chance alone makes it positive, by about the standard errors of the frequencies.
    debiased: the same with each squared distance reduced by its sampling variance, at least to 0 (Kumar, Liang and Ma,
        NeurIPS 2019, there for the squared error).
    bias: mean prediction minus frequency.
    brier: mean squared distance of a prediction to the outcome, reliability - resolution + base + within.
    reliability, resolution: of the bins. base: the Brier score of the base rate. within: what binning leaves out.
    predicted, observed, weight: of each bin, [bins]; the weights add up to 1.
    """

    episodes: int
    successes: int
    plans: int
    error: Interval
    debiased: Interval
    bias: Interval
    brier: float
    reliability: float
    resolution: float
    base: float
    within: float
    predicted: Array
    observed: Array
    weight: Array

    @property
    def skill(self) -> float:
        """The part of the base rate's Brier score that the predictions save: 1 at best, 0 for the base rate itself."""
        return 1.0 - self.brier / self.base if self.base > 0.0 else float("nan")


def calibration(predicted: Sequence[Sequence[float]], succeeded: Sequence[bool], *, seed: int = 0) -> Calibration:
    """Compare the predictions of every episode's plans with its outcome.

    Args:
        predicted: probabilities, for each episode those of its plans, at least one. succeeded: of each episode.
        seed: of the resampling.

    Raises:
        ValueError: no episode, an episode without a plan, or a number that is no probability.
    """
    if len(predicted) != len(succeeded) or not succeeded or any(len(one) == 0 for one in predicted):
        raise ValueError("calibration needs at least one episode, each with an outcome and a plan")
    p = np.concatenate([np.asarray(one, dtype=np.float64) for one in predicted])
    if not ((p >= 0.0) & (p <= 1.0)).all():
        raise ValueError("probabilities must lie between 0 and 1")
    lengths = np.array([len(one) for one in predicted])
    owner = np.repeat(np.arange(len(lengths)), lengths)
    weight = np.repeat(1.0 / lengths, lengths)
    y = np.asarray(succeeded, dtype=np.float64)
    number = _bins(p, weight, max(1, min(MOST_BINS, len(y) // EPISODES_PER_BIN)))
    shares, sums = (_table(owner, number, values, len(y)) for values in (weight, weight * p))
    tables = _Tables(shares, sums, shares * y[:, None])
    value = _errors(np.ones((1, len(y))), tables)
    draws = np.random.default_rng(seed).multinomial(len(y), np.full(len(y), 1.0 / len(y)), size=RESAMPLES)
    resampled = _errors(draws.astype(np.float64), tables)
    total = shares.sum(0)
    mean, rate = sums.sum(0) / total, tables.successes.sum(0) / total
    part, overall = total / len(y), y.mean()
    brier = float((weight * (p - y[owner]) ** 2).sum() / len(y))
    reliability, resolution = float(part @ (mean - rate) ** 2), float(part @ (rate - overall) ** 2)
    base = float(overall * (1.0 - overall))
    (error, debiased, bias), (errors, all_debiased, biases) = value, resampled
    return Calibration(
        episodes=len(y),
        successes=int(y.sum()),
        plans=len(p),
        error=_of_distances(float(error[0]), errors),
        debiased=_of_distances(float(debiased[0]), all_debiased),
        bias=Interval(float(bias[0]), *np.quantile(biases, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0]).tolist()),
        brier=brier,
        reliability=reliability,
        resolution=resolution,
        base=base,
        within=brier - (reliability - resolution + base),
        predicted=mean,
        observed=rate,
        weight=part,
    )


class _Tables(NamedTuple):
    """For each episode and bin, [E, bins]: sums over its plans there."""

    shares: Array  # of weights
    predictions: Array  # of weights times predictions
    successes: Array  # of weights times outcomes


def _bins(p: Array, weight: Array, bins: int) -> NDArray[np.int64]:
    """Number of the bin of each prediction [n]: bins of about equal weight; equal predictions share one."""
    order = np.argsort(p, kind="stable")
    before = np.cumsum(weight[order]) - weight[order]
    edges = np.searchsorted(before, weight.sum() * np.arange(1, bins) / bins)
    borders = np.unique(p[order][np.minimum(edges, len(p) - 1)])
    return np.unique(np.searchsorted(borders, p, side="right"), return_inverse=True)[1]


def _table(owner: NDArray[np.int64], number: NDArray[np.int64], values: Array, episodes: int) -> Array:
    table = np.zeros((episodes, number.max() + 1))
    np.add.at(table, (owner, number), values)
    return table


def _errors(counts: Array, tables: _Tables) -> tuple[Array, Array, Array]:
    """Calibration error, the debiased one and the bias, each [R], of samples with `counts: [R, E]` of each episode."""
    off = tables.predictions - tables.successes  # [E, bins]
    total = counts @ tables.shares  # [R, bins]
    empty = total == 0.0
    gap = np.where(empty, 0.0, counts @ off / np.where(empty, 1.0, total))
    # The variance of a ratio of sums over episodes, by linearisation.
    squares = counts @ off**2 - 2.0 * gap * (counts @ (off * tables.shares)) + gap**2 * (counts @ tables.shares**2)
    variance = np.where(empty, 0.0, squares / np.where(empty, 1.0, total) ** 2)
    part = total / total.sum(-1, keepdims=True)
    error = (part * np.abs(gap)).sum(-1)
    debiased = (part * np.sqrt(np.maximum(gap**2 - variance, 0.0))).sum(-1)
    return error, debiased, (part * gap).sum(-1)


def _of_distances(value: float, resampled: Array) -> Interval:
    """Bounds of a mean of distances, as far below the estimate as above it, but not below 0.

    Resampling adds noise, which enlarges distances: the usual lower bound would exclude 0 for perfect predictions.
    """
    high = max(value, float(np.quantile(resampled, (1.0 + LEVEL) / 2.0)))
    return Interval(value, max(0.0, 2.0 * value - high), high)
