"""Statistics of evaluations: rates with intervals, a table, and how many plans reach the goal by the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from omegaconf import DictConfig
from scipy.stats import binomtest

from cavin_pyro.evaluation.rollout import OUTCOMES

UNIT = " in the world's unit, metres on the tabletop"
RESAMPLES = 10_000  # of a bootstrap

Rate = dict[str, float]


def counted(count: int, one: str, many: str) -> str:
    """A number of things: "1 push", "2 pushes"."""
    return f"{count} {one if count == 1 else many}"


def wilson(successes: int, trials: int) -> Rate:
    """A rate with its Wilson score interval at 95 %, as fractions: rate, low, high."""
    interval = binomtest(successes, trials).proportion_ci(confidence_level=0.95, method="wilson")
    return {"rate": successes / trials, "low": float(interval.low), "high": float(interval.high)}


def mcnemar(one_alone: int, other_alone: int) -> float:
    """The exact p-value of McNemar's test: whether one of two succeeds in scenes where the other fails as often."""
    return float(binomtest(one_alone, one_alone + other_alone).pvalue) if one_alone + other_alone else 1.0


def hierarchical_interval(success: np.ndarray, groups: np.ndarray) -> tuple[float, float]:
    """95 % interval of a rate by the bootstrap over groups, and over the episodes in each of them.

    Episodes of a group, sampled with replacement, succeed as often as a binomial variable says.

    `success`: bool [N]. `groups`: [N], the training seed of each episode.
    """
    generator = np.random.default_rng(0)
    values = [success[groups == name] for name in np.unique(groups)]
    counts, means = np.array([len(one) for one in values]), np.array([one.mean() for one in values])
    chosen = generator.integers(len(values), size=(RESAMPLES, len(values)))
    samples = (generator.binomial(counts[chosen], means[chosen]) / counts[chosen]).mean(1)
    low, high = np.quantile(samples, (0.025, 0.975))
    return float(low), float(high)


def spread(values: Sequence[float]) -> dict[str, float]:
    """Mean, median and 95th percentile."""
    p95 = float(np.percentile(values, 95))
    return {"mean": float(np.mean(values)), "median": float(np.median(values)), "p95": p95}


def summarize(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The results of an evaluation from its episodes' rows, as written to `results.json`."""
    count = len(rows)
    rates = {name: wilson(sum(row["outcome"] == name for row in rows), count) for name in OUTCOMES}
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
    lines = [f"{title}, {counted(results['episodes'], 'episode', 'episodes')}", f"{'':16}{'rate':>8}   95 % interval"]
    for name in OUTCOMES:
        rate = results[name]
        lines.append(f"{name:16}{100 * rate['rate']:7.1f} %  {100 * rate['low']:5.1f} to {100 * rate['high']:5.1f} %")
    lines.append(f"{'':16}{'mean':>8} {'median':>9} {'95th':>9}")
    for name, unit in (("steps", ""), ("return", ""), ("planning_ms", " ms"), ("subgoal_distance", UNIT)):
        values = results[name]
        if values is not None:
            digits = 3 if unit == UNIT else 1
            row = " ".join(f"{values[key]:9.{digits}f}" for key in ("mean", "median", "p95"))
            lines.append(f"{name:16}{row[1:]}{unit}")
    return "\n".join(lines)


def plan_summary(rows: Sequence[Mapping[str, Any]], config: DictConfig) -> str:
    """How many candidates of the plans in rows of results reach the goal, and what to try if none did and some failed.

    Empty for planners that predict nothing.
    """
    episodes = [[share for share in row.get("shares_reaching_goal") or () if share is not None] for row in rows]
    shares = [share for episode in episodes for share in episode]
    if not shares:
        return ""
    line = f"{100 * sum(shares) / len(shares):.1f} % of candidates reached the goal according to the model"
    if not (without := sum(share == 0.0 for share in shares)):
        return f"{line}, some in each of {len(shares)} plans"
    never = sum(bool(episode) and not any(episode) for episode in episodes)
    line += f"; none did in {without} of {len(shares)} plans"
    line += f", nor in any plan of {never} of {len(rows)} episodes" if len(rows) > 1 and never else ""
    return line if all(row["outcome"] == "success" for row in rows) else f"{line}: {_advice(config)}"


def _advice(config: DictConfig) -> str:
    if config.world.get("_target_"):
        return f"the goal may lie beyond planner.horizon={config.planner.horizon} steps, or the model be untrained"
    others = "" if config.reward == "dense" else " or reward=dense"
    guided = "guidance" in [*(config.planner.get("additions") or ()), *(config.planner.get("add") or ())]
    what = "a longer one" if guided else "planner.add=[guidance], a longer one"
    return f"the goal may lie beyond planner.horizon={config.planner.horizon} pushes; try {what}{others}"
