"""Ends of 95 % intervals, and shares with theirs as text."""

from __future__ import annotations

from collections.abc import Mapping

NORMAL = 1.96  # standard errors to either side, of a 95 % interval


def normal_interval(estimate: Mapping[str, float]) -> tuple[float, float]:
    """Both ends of the interval of an estimate with `mean` and `standard_error`, by the normal distribution."""
    half = NORMAL * estimate["standard_error"]
    return estimate["mean"] - half, estimate["mean"] + half


def as_percent(interval: Mapping[str, float], digits: int = 0) -> str:
    """A share with its interval (`mean`, `low`, `high`), in per cent with so many digits; the ends within 0 and 1."""
    low, high = max(0.0, interval["low"]), min(1.0, interval["high"])
    return f"{interval['mean']:.{digits}%} ({low:.{digits}%} to {high:.{digits}%})"
