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
