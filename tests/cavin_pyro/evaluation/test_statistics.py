from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from cavin_pyro.evaluation.statistics import spread, summarize, table, wilson


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # Published examples: 95 % score intervals, to four digits.
    [(0, 10, 0.0, 0.2775), (1, 10, 0.0179, 0.4042), (8, 10, 0.4902, 0.9433), (10, 10, 0.7225, 1.0)]
    + [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilsons_interval_is_the_published_one(successes: int, trials: int, low: float, high: float) -> None:
    rate = wilson(successes, trials)
    assert rate["rate"] == successes / trials
    assert (rate["low"], rate["high"]) == pytest.approx((low, high), abs=6e-5)


@pytest.mark.parametrize(("successes", "trials"), [(0, 1), (3, 7), (199, 200), (200, 200)])
def test_wilsons_interval_holds_the_rates_that_the_score_test_accepts(successes: int, trials: int) -> None:
    """At either end p, the rate lies 1.96 standard errors of p away: |rate - p| = z sqrt(p (1 - p) / n)."""
    rate = wilson(successes, trials)
    for end in (rate["low"], rate["high"]):
        if 0.0 < end < 1.0:
            error = math.sqrt(end * (1 - end) / trials)
            assert abs(rate["rate"] - end) == pytest.approx(1.959964 * error, rel=1e-6)


def test_the_spread_of_one_to_a_hundred() -> None:
    values = spread(list(np.random.default_rng(0).permutation(np.arange(1.0, 102.0))))
    assert values == {"mean": 51.0, "median": 51.0, "p95": 96.0}


def rows() -> list[dict[str, Any]]:
    outcomes = ["success"] * 6 + ["violation", "fall", "timeout", "timeout"]
    return [
        {
            "seed": seed,
            "outcome": outcome,
            "steps": seed + 1,
            "return": -1.0 * seed,
            "subgoal_distance": 0.1,
            "planning_ms": [10.0, 30.0],
        }
        for seed, outcome in enumerate(outcomes)
    ]


def test_a_summary_has_a_rate_for_every_outcome_and_all_episodes() -> None:
    results = summarize(rows())
    assert results["episodes"] == 10
    rates = {name: results[name]["rate"] for name in ("success", "violation", "fall", "timeout")}
    assert rates == {"success": 0.6, "violation": 0.1, "fall": 0.1, "timeout": 0.2}
    assert results["success"] == wilson(6, 10)
    assert results["steps"] == spread([float(number) for number in range(1, 11)])
    assert results["planning_ms"] == {"mean": 20.0, "median": 20.0, "p95": 30.0}
    assert results["per_episode"] == rows()


def test_episodes_that_end_within_a_segment_leave_the_mean_subgoal_distance_to_the_others() -> None:
    first, *others = rows()
    results = summarize([{**first, "subgoal_distance": None}, *others])
    assert results["subgoal_distance"]["mean"] == pytest.approx(0.1)


def test_a_planner_without_subgoals_has_no_subgoal_distance() -> None:
    without = [{**row, "subgoal_distance": None} for row in rows()]
    results = summarize(without)
    assert results["subgoal_distance"] is None
    assert "subgoal" not in table(results, "random")


def test_the_table_shows_percentages_with_intervals() -> None:
    text = table(summarize(rows()), "crossing")
    assert text.startswith("crossing, 10 episodes\n")
    assert "success            60.0 %   31.3 to  83.2 %" in text
    assert "subgoal_distance   0.100     0.100     0.100 m" in text
    assert max(map(len, text.splitlines())) < 60
