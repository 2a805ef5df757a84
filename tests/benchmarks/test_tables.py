"""The tables of README and docs/results.md follow from docs/results, and episodes and errors are measured as told."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from pyarrow import parquet

from cavin_pyro.config.composition import compose
from tests.cavin_pyro.conftest import run_script

ROOT = Path(__file__).parents[2]


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """A script of benchmarks as a module."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return lambda name: sys.modules.get(name) or __import__(name)


@pytest.mark.parametrize("page", ["README.md", "docs/results.md"])
def test_the_tables_are_those_that_the_command_writes(page: str, load: Callable[[str], ModuleType]) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert "<!-- table: " in text and load("tables").written(text) == text


def test_the_cards_of_shipped_models_are_those_that_the_command_writes(tmp_path: Path) -> None:
    ended = run_script(ROOT / "docs" / "model_cards.py", "--check", folder=tmp_path)
    assert ended.status == 0, ended.errors


def test_another_outcome_changes_the_table(load: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch) -> None:
    tables = load("tables")
    before, rows = tables.success(), tables.read("success")
    next(row for row in rows if row["outcome"] == "success")["outcome"] = "fall"
    monkeypatch.setattr(tables, "read", lambda name: rows)
    assert tables.success() != before


def test_pairs_and_blocks_of_seeds_are_counted(load: Callable[[str], ModuleType]) -> None:
    tables = load("tables")
    one = [{"seed": seed, "outcome": "success" if seed < 13 else "fall"} for seed in range(10, 20)]
    other = [{"seed": seed, "outcome": "success" if seed > 11 else "fall"} for seed in (10, 11, 12, 13, 30)]
    assert tables.paired(one, other) == (2, 1, 1.0)
    assert tables.seeds(other) == "10 to 13, 30 to 30"
    assert tables.rate(one) == "30.0 % (10.8–60.3)"


def test_every_episode_of_the_results_is_kept_once() -> None:
    for file in sorted((ROOT / "docs" / "results").glob("*.parquet")):
        rows = parquet.read_table(file).to_pylist()
        if "seed" in rows[0] and "outcome" in rows[0]:
            keys = ("row", "task", "objects", "rules", "seed")
            assert len({tuple(row.get(key) for key in keys) for row in rows}) == len(rows), file
    size = sum(file.stat().st_size for file in (ROOT / "docs" / "results").iterdir())
    assert size < 2_000_000


def test_episodes_are_added_once(
    load: Callable[[str], ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    episodes = load("episodes")
    row = episodes.Row("random pushes", "clearing", 1, ("planner=random", "maximum_steps=2", "criterion=published"))
    monkeypatch.setitem(episodes.TABLES, "success", [row])
    for count in ("1", "2"):
        options = ["--seed", "3", "--episodes", count, "--workers", "1", "--results", str(tmp_path)]
        monkeypatch.setattr(sys, "argv", ["episodes.py", "success", *options])
        episodes.main()
    rows = parquet.read_table(tmp_path / "success.parquet").to_pylist()
    expected = [(rules, seed) for seed in (3, 4) for rules in ("published", "strict")]
    assert [(row["rules"], row["seed"]) for row in rows] == expected
    assert {row["planner"] for row in rows} == {"random"} and all(row["commit"] for row in rows)


@pytest.mark.soak
def test_errors_of_predictions_stand_beside_their_floor(tmp_path: Path) -> None:
    arguments = ("contact", "--seed", "4", "--episodes", "1", "--redraws", "1", "--output", str(tmp_path / "a.parquet"))
    ended = run_script(ROOT / "benchmarks" / "accuracy.py", *arguments, folder=tmp_path)
    assert ended.status == 0, ended.errors
    rows = parquet.read_table(tmp_path / "a.parquet").to_pylist()
    assert {row["predictor"] for row in rows} >= {"hidden", "camera", "contact, f"}
    assert all(row["error"] >= 0.0 and row["pushes"] in (1, 3) for row in rows)


@pytest.mark.parametrize("size", ["3", "shipped"])
def test_commands_know_the_options_that_competence_gives_them(size: str, load: Callable[[str], ModuleType]) -> None:
    making, evaluations = load("competence").commands("tabletop", size, 1, Path("a folder"))
    evaluated = [row.overrides(0) for row in load("competence").rows_of("a name", evaluations)]
    assert len(evaluated) == 6 and all(compose("evaluate", *options) for options in evaluated)
    assert all(compose(command, *options).output.startswith("a folder/") for command, options in making.items())


@pytest.mark.soak
def test_a_point_of_each_panel_is_measured(tmp_path: Path) -> None:
    ended = run_script(ROOT / "benchmarks" / "growth.py", "--quick", "--output", str(tmp_path), folder=tmp_path)
    assert ended.status == 0 and (tmp_path / "pictures" / "growth.png").exists(), ended.errors
    rows = parquet.read_table(tmp_path / "results" / "growth.parquet").to_pylist()
    assert len(rows) == 6 and all(row["median_ms"] > 0 and row["peak_mb"] > 100 for row in rows)
