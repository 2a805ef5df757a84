"""Rates with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

Rate = dict[str, float]


def wilson(successes: int, trials: int) -> Rate:
    """A rate with its Wilson score interval at 95 %, as fractions: rate, low, high."""
    interval = binomtest(successes, trials).proportion_ci(confidence_level=0.95, method="wilson")
    return {"rate": successes / trials, "low": float(interval.low), "high": float(interval.high)}


def mcnemar(one_alone: int, other_alone: int) -> float:
    """The exact p-value of McNemar's test: whether one of two succeeds in scenes where the other fails as often."""
    return float(binomtest(one_alone, one_alone + other_alone).pvalue) if one_alone + other_alone else 1.0


def spread(values: Sequence[float]) -> dict[str, float]:
    """Mean, median and 95th percentile."""
    return {
        "mean": float(np.mean(values)),
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
    }


def summarize(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The results of an evaluation from its episodes' rows, as written to `results.json`."""
    count = len(rows)
    rates = {
        name: wilson(sum(row["outcome"] == name for row in rows), count)
        for name in ("success", "violation", "fall", "timeout")
    }
    # An episode that ends before its first segment does has no distance, nor has a planner without subgoals.
    distances = [row["subgoal_distance"] for row in rows if row["subgoal_distance"] is not None]
    return {
        "episodes": count,
        **rates,
        "steps": spread([row["steps"] for row in rows]),
        "return": spread([row["return"] for row in rows]),
        "planning_ms": spread([value for row in rows for value in row["planning_ms"]]),
        "subgoal_distance": spread(distances) if distances else None,
        "per_episode": list(rows),
    }


def table(results: dict[str, Any], title: str) -> str:
    """The results as a table for people; rates in per cent with their intervals."""
    lines = [f"{title}, {results['episodes']} episodes", f"{'':16}{'rate':>8}   95 % interval"]
    for name in ("success", "violation", "fall", "timeout"):
        rate = results[name]
        lines.append(f"{name:16}{100 * rate['rate']:7.1f} %  {100 * rate['low']:5.1f} to {100 * rate['high']:5.1f} %")
    lines.append(f"{'':16}{'mean':>8} {'median':>9} {'95th':>9}")
    for name, unit in (("steps", ""), ("return", ""), ("planning_ms", " ms"), ("subgoal_distance", " m")):
        values = results[name]
        if values is not None:
            digits = 3 if unit == " m" else 1
            row = " ".join(f"{values[key]:9.{digits}f}" for key in ("mean", "median", "p95"))
            lines.append(f"{name:16}{row[1:]}{unit}")
    return "\n".join(lines)
