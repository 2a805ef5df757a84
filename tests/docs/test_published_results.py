"""The published tables and pictures follow from the published table of episodes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cavin_pyro.reproduction.results import PAGE, write_results
from cavin_pyro.reproduction.table import TABLE, Row, read_table
from tests.docs.pages import ROOT

PUBLISHED = ROOT / "docs" / "measurements" / "reproduction"


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return read_table(PUBLISHED / TABLE)


def test_the_page_of_results_is_what_the_table_of_episodes_says(rows: list[Row], tmp_path: Path) -> None:
    page = (PUBLISHED / PAGE).read_text()
    (command,) = re.findall(r"^    (python -m cavin_pyro\.reproduce .*)$", page, re.M)
    assert command == f"python -m cavin_pyro.reproduce table={(PUBLISHED / TABLE).relative_to(ROOT)}"
    written = write_results(tmp_path, rows, command)
    assert (tmp_path / PAGE).read_text() == page
    pictures = {path.name for path in written if path.suffix == ".png"}
    assert pictures <= {path.name for path in PUBLISHED.glob("*.png")}


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
