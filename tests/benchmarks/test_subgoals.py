"""What any motion leaves of the way to a subgoal is at most what chosen ones leave."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.benchmarks.loading import load
from tests.cavin_pyro.conftest import run_script

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def benchmark() -> Any:
    return load("subgoals")


@pytest.mark.soak
def test_no_choice_leaves_less_than_the_simulators(tmp_path: Path, benchmark: Any) -> None:
    log = tmp_path / "log.jsonl"

    def run(scenes: int, samples: int = 12) -> list[str]:
        given = ("--scenes", str(scenes), "--samples", str(samples), "--seed", "12001", "--log", str(log))
        ended = run_script(ROOT / "benchmarks" / "subgoals.py", *given, folder=ROOT)
        assert ended.status == 0, ended.errors
        return ended.output.splitlines()

    run(1)
    printed, first = run(2), log.read_text().splitlines()
    rows = [json.loads(line) for line in first]
    assert [row["scene"] for row in rows] == [0, 1] and printed[0] == "2 of 2 scenes"
    for row in rows:
        least, *others = (row[name] for name in reversed(benchmark.WAYS))
        assert all(least <= other for other in others) and least < row["way"]
    assert run(2) == printed and log.read_text().splitlines() == first  # nothing is left to play
    run(1, samples=4)  # other motions: scenes of their own
    assert len(log.read_text().splitlines()) == 3


def test_what_is_left_is_the_ratio_of_sums(benchmark: Any) -> None:
    names = benchmark.WAYS
    rows = [{"way": way, **dict(zip(names, left, strict=True))} for way, left in ((0.1, (0.1, 0.05, 0.04, 0.01)),) * 3]
    rows.append({"way": 0.3, **dict.fromkeys(names, 0.3)})  # a subgoal that no motion comes nearer to
    rows.append({"way": 0.3, **dict.fromkeys(names, float("inf"))})  # everything falls
    rows.append({"way": 0.0, **dict.fromkeys(names, 0.0)})  # nothing is to move
    title, *shares = benchmark.lines(rows)
    assert title == "4 of 6 scenes"
    assert [line.split("(")[0].split()[-1] for line in shares] == ["100.0%", "75.0%", "70.0%", "55.0%"]
