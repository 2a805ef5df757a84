"""`shard=i/n` of evaluate, for those who have only a shell and many machines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import cavin_pyro
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.evaluation import run_missing, seeds_of
from cavin_pyro.storage.run_directory import write_config

SHORT = ("maximum_steps=2", "workers=1", "episodes=5", "objects=2", "planner=random", "seed=7")


def run(folder: Path, *overrides: str) -> list[dict[str, Any]]:
    folder.mkdir(exist_ok=True)
    config = compose("evaluate", *SHORT, *overrides, f"output={folder}")
    write_config(folder, config)
    (rows,) = run_missing([config], 1)
    assert sorted(map(json.dumps, rows)) == sorted((folder / "episodes.jsonl").read_text().splitlines())
    return without_times(rows)


def without_times(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{name: value for name, value in row.items() if name != "planning_ms"} for row in rows]


def test_joined_shards_are_the_whole_evaluation(tmp_path: Path) -> None:
    whole = run(tmp_path / "whole")
    parts = [run(tmp_path / f"part-{number}", f"shard={number}/3") for number in (1, 2, 3)]
    assert [[row["seed"] for row in part] for part in parts] == [[7, 10], [8, 11], [9]]
    (tmp_path / "joined").mkdir()
    every = "".join((tmp_path / f"part-{number}" / "episodes.jsonl").read_text() for number in (3, 1, 2))
    (tmp_path / "joined" / "episodes.jsonl").write_text(every)
    assert run(tmp_path / "joined") == whole
    assert sorted((tmp_path / "joined" / "episodes.jsonl").read_text()) == sorted(every)  # none has run again


def test_a_shard_without_an_episode_is_refused() -> None:
    with pytest.raises(UserError, match="shard=6/6 has none of 5 episodes: choose a smaller n"):
        seeds_of(compose("evaluate", *SHORT, "shard=6/6"))


def test_evaluations_in_python_return_what_their_folders_hold_and_are_compared(tmp_path: Path) -> None:
    options = {"planner": "random", "episodes": 2, "workers": 1, "maximum_steps": 2}
    first = cavin_pyro.evaluate(**options, output=tmp_path / "a")
    assert json.loads((tmp_path / "a" / "results.json").read_text())["per_episode"] == first["per_episode"]
    assert first["episodes"] == 2 and (tmp_path / "a" / "results.txt").read_text().startswith("crossing, layout 0")
    assert cavin_pyro.compare(first, tmp_path / "a")["p"].iloc[1] == 1.0
    cavin_pyro.evaluate(**options, output=tmp_path / "b", objects=1)
    with pytest.raises(UserError, match="has objects=1, not 3: its scenes differ"):
        cavin_pyro.compare(tmp_path / "a", tmp_path / "b")
