"""Long runs stay flat, and the benchmark that says so tells one that does not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.benchmarks.loading import FOLDER, load

FILE = FOLDER / "long_runs.py"


@pytest.fixture(scope="module")
def long_runs() -> Any:
    return load("long_runs")


@pytest.mark.parametrize("rising", [None, "memory_mb", "files", "clients", "turn_ms"])
def test_a_quantity_that_rises_is_told_from_noise(rising: str | None, long_runs: Any) -> None:
    noise = np.random.default_rng(0)
    measured = []
    for number in range(1, 81):
        values = {
            "memory_mb": 500 + noise.normal(0, 0.5) + 50 * (number < 10),  # caches fill
            "files": 12.0,
            "clients": 1.0,
            "turn_ms": 40 * noise.lognormal(0, 0.2),
        }
        if rising is not None:
            values[rising] += {"memory_mb": 0.5, "files": 1.0, "clients": 1.0, "turn_ms": 0.5}[rising] * number
        measured.append(long_runs.Measurement(turn=100 * number, **values))
    assert [one.name for one in long_runs.slopes(measured) if one.rises] == ([rising] if rising else [])


@pytest.mark.soak
def test_turns_stay_flat_and_leaks_on_purpose_do_not(long_runs: Any) -> None:
    """In so few turns only large slopes can be told: a leak is of 8 MB, a file and a simulation a turn."""
    flat = long_runs.slopes(list(long_runs.measure(16, 1)), memory_limit=3000.0, time_limit=2.0)
    assert not [str(one) for one in flat if one.rises]
    leak = ("memory_mb", "files", "clients")
    leaking = long_runs.slopes(list(long_runs.measure(12, 1, leak=leak)), memory_limit=3000.0, time_limit=2.0)
    assert [one.name for one in leaking if one.rises] == list(leak)


@pytest.mark.soak
def test_the_command_ends_with_1_when_something_rises_and_goes_on_after_its_log(tmp_path: Path) -> None:
    line = [sys.executable, str(FILE), "--every", "2", "--log", str(tmp_path / "log.jsonl")]
    flat = subprocess.run(
        [*line, "--turns", "16", "--memory-limit", "3000", "--time-limit", "5"], capture_output=True, text=True
    )
    assert flat.returncode == 0, flat.stdout + flat.stderr
    assert "16 turns" in flat.stdout and "RISES" not in flat.stdout
    risen = subprocess.run([*line, "--turns", "32", "--leak", "files"], capture_output=True, text=True)
    assert risen.returncode == 1
    assert "16 turns" in risen.stdout and "| files |" in risen.stdout and "RISES" in risen.stdout
