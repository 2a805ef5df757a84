"""The benchmarks run; what they measure is no test."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def run(name: str, *words: str) -> str:
    command = [sys.executable, str(ROOT / "benchmarks" / f"{name}.py"), *words]
    surroundings = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        command, cwd=ROOT, env=surroundings, check=True, capture_output=True, text=True, timeout=300
    ).stdout


def test_training_by_hand_has_the_same_loss_and_is_timed_against_pyro() -> None:
    printed = run("training", "8")  # asserts that both losses are equal
    assert re.search(r"batch 8: Pyro [\d.]+ ms, hand-written torch [\d.]+ ms, ratio [\d.]+", printed)


def test_a_plan_is_timed_and_its_operations_are_counted() -> None:
    *_, alone, together = run("planning", "--quick", "--no-flat").splitlines()
    # samples, objects, batch, ms per plan, GFLOP per plan, share
    assert alone.split()[:3] == ["32", "2", "1"] and together.split()[:3] == ["32", "2", "2"]
    assert float(alone.split()[4]) == float(together.split()[4]) > 0.0
