"""The published tables and pictures follow from the published table of episodes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from cavin_pyro.reproduction.results import PAGE, write_results
from cavin_pyro.reproduction.table import CRITERIA, TABLE, Row, read_table
from tests.benchmarks.loading import load
from tests.docs.pages import ROOT

PUBLISHED = ROOT / "docs" / "measurements" / "reproduction"
FOLDERS = (PUBLISHED, PUBLISHED / "12000-steps")


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return read_table(PUBLISHED / TABLE)


@pytest.fixture(autouse=True)
def figures_are_not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """What takes most of the time; tests/cavin_pyro/reproduction draws them."""

    def save_empty(figure: Figure, target: Any, **_: Any) -> None:
        Path(target).touch()

    monkeypatch.setattr(Figure, "savefig", save_empty)


@pytest.mark.parametrize(
    "folder",
    [pytest.param(one, id=one.name, marks=[] if one == PUBLISHED else pytest.mark.soak) for one in FOLDERS],
)
def test_the_page_of_results_is_what_the_table_of_episodes_says(folder: Path, tmp_path: Path) -> None:
    rows, page = read_table(folder / TABLE), (folder / PAGE).read_text()
    (command,) = re.findall(r"^    (python -m cavin_pyro\.reproduce .*)$", page, re.M)
    assert command == f"python -m cavin_pyro.reproduce table={(folder / TABLE).relative_to(ROOT)}"
    written = write_results(tmp_path, rows, command)
    assert (tmp_path / PAGE).read_text() == page
    pictures = {path.name for path in written if path.suffix == ".png"}
    assert pictures <= {path.name for path in folder.glob("*.png")}


def test_another_outcome_would_change_the_page(rows: list[Row], tmp_path: Path) -> None:
    page = (PUBLISHED / PAGE).read_text()
    (command,) = re.findall(r"^    (python -m cavin_pyro\.reproduce .*)$", page, re.M)
    lost = next(row for row in rows if row["strict_outcome"] == "success")
    changed = [{**row, "strict_outcome": "timeout"} if row is lost else row for row in rows]
    write_results(tmp_path, changed, command)
    assert (tmp_path / PAGE).read_text() != page


def test_every_episode_is_of_another_scene_training_or_cell(rows: list[Row]) -> None:
    names = ("method", "planner", "task", "reward", "objects", "training_seed", "seed")
    assert len({tuple(row[name] for name in names) for row in rows}) == len(rows)


def test_the_prose_about_the_claims_quotes_the_page_of_results() -> None:
    prose = (PUBLISHED.parent / "reproduction.md").read_text()
    (claims,) = re.findall(r"^## What reproduced.*?(?=^## )", prose, re.M | re.S)
    measured = [row.split("|")[2] for row in claims.splitlines() if row.startswith("| ") and row.count("|") >= 4]
    quoted = {number for cell in measured for number in re.findall(r"\d+\.\d", cell)}
    page = (PUBLISHED / PAGE).read_text()
    assert len(quoted) > 10
    assert not {number for number in quoted if not re.search(rf"(?<![\d.]){re.escape(number)}(?!\d)", page)}


def test_the_explanation_of_the_reports_quotes_rows_of_the_measurements() -> None:
    explanation = (ROOT / "docs" / "explanation" / "model-criticism.md").read_text(encoding="utf-8")
    measured = (PUBLISHED.parent / "criticism.md").read_text(encoding="utf-8").partition("\n## cavin with")[0]
    rows = [line for line in explanation.splitlines() if line.startswith("| ")]
    assert len(rows) > 30
    assert not [row for row in rows if row not in measured.splitlines()]


@pytest.mark.soak
def test_the_page_shows_what_the_table_of_factors_says() -> None:
    factors, page = load("factors"), (PUBLISHED.parent / "reproduction.md").read_text().splitlines()
    rows = factors.stored(PUBLISHED / "factors.parquet")
    shown = [line for criterion in CRITERIA for line in factors.lines(rows, criterion)]
    assert len(shown) == 2 * (10 + 1 + 8) and set(shown) - {""} <= set(page)
    assert len({(row["data"], row["method"], row["planner"], row["objects"], row["seed"]) for row in rows}) == len(rows)
