"""Rows of finished episodes on disk, their statistics, and two methods on the same scenes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.rows import finished_episodes
from cavin_pyro.evaluation.statistics import plan_summary, spread, summarize, table, wilson

ROW: dict[str, Any] = {
    "seed": 10,
    "outcome": "success",
    "steps": 4,
    "return": 7.5,
    "strict_outcome": "violation",
    "strict_steps": 2,
    "strict_return": 1.5,
    "unsafe": 0,
    "ineffective": 1,
    "plans": 2,
    "plans_reaching_goal": 2,
    "shares_reaching_goal": [0.25, None],
    "subgoal_distance": None,
    "planning_ms": [1.5, 2],
}


def written(folder: Path, *rows: Any) -> Path:
    path = folder / "episodes.jsonl"
    path.write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    return path


def test_whole_rows_are_read(tmp_path: Path) -> None:
    path = written(tmp_path, ROW, {**ROW, "seed": 11}, ROW)
    with open(path, "a") as file:
        file.write('{"seed": 12, "outc')  # cut off by a kill
    assert finished_episodes(path) == {10: ROW, 11: {**ROW, "seed": 11}}


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ([1], "its keys must be "),
        ({**ROW, "seed": 11, "outcome": "sucess"}, 'outcome cannot be "sucess")'),
        ({**ROW, "seed": 11, "planning_ms": ["fast"]}, 'planning_ms cannot be ["fast"])'),
        ({**ROW, "seed": 11, "steps": -5}, "steps cannot be -5)"),
        ({**ROW, "steps": 5}, "an earlier line has another episode with seed 10)"),
    ],
)
def test_a_line_that_is_no_episode_is_named(row: Any, said: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as refused:
        finished_episodes(written(tmp_path, ROW, row))
    assert f"episodes.jsonl, line 2 is no episode ({said}" in str(refused.value)


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # Published examples: 95 % score intervals, to four digits.
    [(0, 10, 0.0, 0.2775), (8, 10, 0.4902, 0.9433), (10, 10, 0.7225, 1.0), (81, 263, 0.2553, 0.3662)],
)
def test_wilsons_interval_is_the_published_one(successes: int, trials: int, low: float, high: float) -> None:
    rate = wilson(successes, trials)
    assert rate["rate"] == successes / trials
    assert (rate["low"], rate["high"]) == pytest.approx((low, high), abs=6e-5)


def test_the_spread_of_one_to_a_hundred() -> None:
    values = spread(list(np.random.default_rng(0).permutation(np.arange(1.0, 102.0))))
    assert values == {"mean": 51.0, "median": 51.0, "p95": 96.0}


def test_a_summary_has_a_rate_for_every_outcome() -> None:
    outcomes = ["success"] * 6 + ["violation", "fall", "timeout", "timeout"]
    rows = [{**ROW, "seed": seed, "outcome": outcome, "steps": seed + 1} for seed, outcome in enumerate(outcomes)]
    rows[0]["subgoal_distance"] = 0.1  # the other episodes ended within their first segment
    results = summarize(rows)
    rates = {name: results[name]["rate"] for name in ("success", "violation", "fall", "timeout")}
    assert rates == {"success": 0.6, "violation": 0.1, "fall": 0.1, "timeout": 0.2}
    assert results["success"] == wilson(6, 10)
    assert results["steps"] == spread([float(number) for number in range(1, 11)])
    assert results["planning_ms"]["mean"] == 1.75 and results["subgoal_distance"]["mean"] == 0.1
    assert "success            60.0 %   31.3 to  83.2 %" in table(results, "crossing")
    assert summarize(rows[1:])["subgoal_distance"] is None


def plans(*shares: float | None) -> dict[str, Any]:
    return {**ROW, "shares_reaching_goal": list(shares)}


def test_plans_without_a_candidate_that_reaches_the_goal_are_counted() -> None:
    config = compose("evaluate", "reward=sparse")
    assert plan_summary([plans(0.5, 1.0)], config).endswith("some in each of 2 plans")
    said = plan_summary([plans(0.0, 0.5)], config)
    assert said.startswith("25.0 %") and "1 of 2 plans" in said and "planner.horizon" not in said
    said = plan_summary([{**plans(0.0, 0.0), "outcome": "timeout"}, plans(0.5)], config)
    assert "2 of 3 plans" in said and "1 of 2 episodes" in said and "planner.horizon=30" in said
    assert plan_summary([plans(None), {"outcome": "success"}], config) == ""
