"""Methods compared in one table: evaluations, rows in memory, and tables of other programs."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluate import compared
from cavin_pyro.evaluation.comparison import compare, write_page
from cavin_pyro.evaluation.statistics import wilson

COUNTS = ["scenes", "first better", "this better"]


def ended(successes: list[bool], first: int = 0) -> list[dict[str, Any]]:
    return [{"seed": seed, "outcome": ["fall", "success"][one]} for seed, one in enumerate(successes, first)]


def table(path: Path, **columns: Any) -> Path:
    frame = pd.DataFrame(columns)
    frame.to_parquet(path) if path.suffix == ".parquet" else frame.to_csv(path, index=False)
    return path


def test_scenes_of_both_are_counted_by_the_methods_that_solve_them() -> None:
    one = ended([True, True, True, False, False, True])
    found = compare(one, ended([True, False, False, True, False, True]))
    assert found.loc["method 2", COUNTS].tolist() == [6, 2, 1]
    assert compare(ended([True] * 5), ended([False] * 5, first=3)[::-1])["p"].iloc[1] == 0.5


def test_tables_of_other_programs_have_intervals_and_a_page(tmp_path: Path) -> None:
    one = table(tmp_path / "one.csv", seed=range(10), success=[1] * 8 + [0] * 2, steps=[0] + [3] * 9)
    two = table(tmp_path / "two.parquet", seed=range(2, 12), success=[False] * 7 + [True] * 3)
    found = compare(one, two)
    low, high = (100 * wilson(8, 10)[name] for name in ("low", "high"))
    columns = ["success", "interval", "solved at the start"]
    assert found.loc[str(one), columns].tolist() == ["80.0 %", f"{low:.1f} to {high:.1f}", "10.0 %"]
    write_page(tmp_path / "page.html", found)
    assert "<td>80.0 %</td>" in (tmp_path / "page.html").read_text()


def test_trainings_that_differ_widen_the_interval_and_scenes_count_once() -> None:
    good, bad = ([ended([True] * rate + [False] * (10 - rate)) for rate in rates] for rates in ((10, 9, 5), (3, 3, 3)))
    found = compare(good=good, bad=bad)
    ends = [[*map(float, found.loc["good", name].split(" to "))] for name in ("over trainings", "interval")]
    assert ends[0][1] - ends[0][0] > ends[1][1] - ends[1][0]
    assert found.loc["bad", COUNTS].tolist() == [10, 7, 0]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (ended([True], first=1) * 2, "^method 2 has seed 1 twice"),
        (ended([True], first=7), "^method 2 and method 1 have no seed in common"),
        ([{"seed": 1, "success": "yes"}], "^method 2, of list, has a success that cannot be"),
        ([{"seed": 1, "success": True, "training": math.nan}], "has a training that cannot be"),
        ("http://127.0.0.1:9/x.csv", "^there is no table http:"),
    ],
)
def test_what_cannot_be_compared_is_one_line(rows: Any, said: str) -> None:
    with pytest.raises(UserError, match=said):
        compare(ended([True], first=1), rows)


def test_damaged_results_are_not_compared_with(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("seed: 3\n")
    for rows in ({"a": 1}, ended([True]), "text"):
        (tmp_path / "results.json").write_text(json.dumps({"per_episode": rows}))
        with pytest.raises(UserError, match=r"holds damaged results \(.*\): evaluate it again"):
            compare(tmp_path)


def test_a_sweep_is_compared_where_its_runs_met_the_same_scenes(tmp_path: Path) -> None:
    files = {
        name: {"folder": str(table(tmp_path / f"{name}.csv", seed=seeds, success=[1, 0]))}
        for name, seeds in (("one", [1, 2]), ("other", [1, 2]), ("elsewhere", [3, 4]))
    }
    assert "p, Holm" in compared({name: files[name] for name in ("one", "other")})
    assert "p, Holm" not in (said := compared(files)) and "elsewhere" in said


def test_the_command_compares_and_refuses(shell: SimpleNamespace, tmp_path: Path) -> None:
    for name in ("a", "b"):
        table(tmp_path / f"{name}.csv", seed=[1, 2], success=[1, 0], method=["theirs"] * 2)
    answer = shell.run_command("compare", "a.csv", "--method", "mine", "b.csv", folder=tmp_path)
    assert answer.status == 0 and "mine" in answer.output.splitlines()[2] and (tmp_path / "compare.html").exists()
    for words in (
        ["a.csv", "nowhere"],
        ["a.csv", "b.csv"],
        ["a.csv", "--output", "a.csv"],
        ["--method", "a", "a.csv", "--method", "a", "b.csv"],
        ["a.csv", "--method", "", "b.csv"],
    ):
        answer = shell.run_command("compare", *words, folder=tmp_path)
        assert (answer.status, answer.errors.count("\n")) == (2, 1)
    assert (tmp_path / "a.csv").read_text().startswith("seed")
