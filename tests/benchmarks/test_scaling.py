"""The simulated queue takes as long as one can tell beforehand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.benchmarks.loading import load

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def scaling() -> Any:
    return load("scaling")


@pytest.mark.parametrize(
    ("seconds", "workers", "costs", "makespan", "limit"),
    [
        ([1.0] * 4, 2, {"start": 3.0, "main": 0.0}, 5.0, "start-up"),
        ([10.0, 1.0, 1.0, 1.0], 4, {"start": 0.0, "main": 0.0}, 10.0, "the last episodes"),
        ([1.0, 1.0, 4.0], 2, {"start": 0.0, "main": 0.0}, 5.0, "the last episodes"),
        ([1.0] * 3, 1, {"start": 2.0, "main": 0.5}, 6.5, "start-up"),
        ([0.5] * 100, 50, {"start": 0.0, "main": 1.0}, 100.5, "the main process"),
        ([1.0] * 100, 1, {"start": 0.0, "main": 0.5, "ahead": 1}, 100.5, "the main process"),
        ([1.0] * 3, 8, {"start": 1.0, "main": 0.0}, 2.0, "the last episodes"),  # five workers have nothing to do
    ],
)
def test_a_run_takes_what_one_can_tell_beforehand(
    scaling: Any, seconds: list[float], workers: int, costs: dict, makespan: float, limit: str
) -> None:
    made = scaling.simulate(seconds, workers, **costs)
    assert made.makespan == pytest.approx(makespan)
    if makespan != 100.5 or workers > 1:  # with a job ahead, one worker never waits
        assert made.limit == limit


def test_shares_of_the_workers_time_are_all_of_it_and_no_run_beats_its_bounds(scaling: Any) -> None:
    seconds = list(np.random.default_rng(0).gamma(2.0, 3.0, 300))
    for workers in (1, 7, 400):
        made = scaling.simulate(seconds, workers, start=5.0, main=0.02)
        shares = (made.busy, made.starting, made.waiting, made.ended)
        assert sum(shares) == pytest.approx(1.0) and min(shares) > -1e-9
        assert made.makespan >= max(5.0 + max(seconds), 5.0 + sum(seconds) / workers, 0.02 * len(seconds))
    assert scaling.simulate(seconds, 400, start=5.0, main=0.02).ended > 0.5


def test_lengths_are_pushes_of_real_episodes_by_seed(scaling: Any) -> None:
    table = ROOT / "docs" / "measurements" / "reproduction" / "episodes.parquet"
    made = scaling.lengths(table, "paper", 0.5, 50, seed=1)
    assert made == scaling.lengths(table, "paper", 0.5, 50, seed=1)
    assert made != scaling.lengths(table, "paper", 0.5, 50, seed=2)
    assert all(one % 0.5 == 0.0 and 0.5 <= one <= 30.0 for one in made)


@pytest.mark.soak
def test_the_table_has_a_line_for_every_number_of_workers() -> None:
    costs = ("--start", "5", "--push", "0.5", "--main", "0.01")
    line = [sys.executable, "benchmarks/scaling.py", "--episodes", "20", "--workers", "1", "16", *costs]
    printed = subprocess.run(line, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    assert [row.split("|")[1:3] for row in printed[-2:]] == [[" 20 ", " 1 "], [" 20 ", " 16 "]]
