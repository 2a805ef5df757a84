"""`reproduce`, from an empty folder to the figure, in its smallest size, and from a table alone."""

from __future__ import annotations

import json
import shutil
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

from cavin_pyro.config.application import Interruption
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.reproduction.cells import cells
from cavin_pyro.reproduction.pipeline import Stage, run_stages
from cavin_pyro.reproduction.results import write_results
from cavin_pyro.reproduction.sizes import SIZES
from cavin_pyro.reproduction.table import as_table, chosen_rows, episode_row, read_table, write_table
from cavin_pyro.storage.checkpoint import load

WHOLE = ("scale=smoke", "methods=[mpc]", "planners=[paper]", "tasks=[clearing]", "objects=[1,3]", "workers=1")
RESULTS = ("episodes.parquet", "statistics.json", "figure-paper-strict.png", "figure-paper-published.png")


def contents(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in RESULTS}


def test_a_reproduction_killed_and_resumed_with_more_episodes_equals_an_unbroken_one(
    shell: SimpleNamespace, tmp_path: Path
) -> None:
    process = shell.start_command("reproduce", *WHOLE, "output=home", folder=tmp_path, quiet=True)
    home = tmp_path / "home"
    while process.poll() is None and not any(path.stat().st_size for path in home.rglob("episodes.jsonl")):
        time.sleep(0.05)
    process.kill()
    process.wait()
    cut = next(path for path in home.rglob("episodes.jsonl") if path.stat().st_size)
    cut.write_bytes(cut.read_bytes()[:-20])  # as a machine that lost its power leaves it
    finished = {path: path.stat().st_mtime_ns for path in home.rglob("training.png")}
    assert len(finished) == 1
    done = shell.run_command("reproduce", *WHOLE, "bottom_episodes=2", "output=home", folder=tmp_path)
    assert done.status == 0 and "home/results.md" in done.output, done.errors
    assert finished == {path: path.stat().st_mtime_ns for path in home.rglob("training.png")}
    assert len(read_table(home / "episodes.parquet")) == 3 + 1
    command = load(home / "train" / "mpc-0" / "checkpoint.safetensors").provenance["command"]
    assert command.startswith("python -m cavin_pyro.train data=home/data ")
    (tmp_path / "models").mkdir()
    shutil.copy(home / "train" / "mpc-0" / "checkpoint.safetensors", tmp_path / "models" / "mpc-0.safetensors")
    options = ("models=models", "bottom_episodes=2", "output=whole")
    whole = shell.run_command("reproduce", *WHOLE, *options, folder=tmp_path)
    assert whole.status == 0, whole.errors
    assert not (tmp_path / "whole" / "train").exists() and contents(tmp_path / "whole") == contents(home)
    other = shell.run_command("reproduce", "scale=small", "output=home", folder=tmp_path)
    assert other.status == 2 and "holds a run with" in other.complaints[0]


def test_a_failed_stage_is_told_with_its_command_and_its_last_line_and_a_signal_ends_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", [])
    stage = Stage("train", ("data=nowhere", "trainer.steps=0"), tmp_path / "train")
    expected = r"train data=nowhere trainer.steps=0 output=.* failed: trainer.steps must be a whole .* \(.*log.txt\)"
    with pytest.raises(UserError, match=expected):
        run_stages([stage], 1)
    monkeypatch.setattr("cavin_pyro.train.main", lambda: sys.exit(128 + signal.SIGTERM))
    with pytest.raises(Interruption) as ended:
        run_stages([stage], 1)
    assert ended.value.args[0].name == "SIGTERM"


def played() -> pd.DataFrame:
    """The table of a small run, in which CAVIN succeeds and MPC runs out of time."""
    rows = []
    for cell in cells(replace(SIZES["smoke"], tasks=("clearing",), object_counts=(1, 3)), ["cavin", "mpc"], ["paper"]):
        outcome = "success" if cell.method == "cavin" else "timeout"
        line = {"seed": cell.seed, "outcome": outcome, "steps": 2, "return": 97.5, "unsafe": 1, "ineffective": 0}
        line |= {"plans": 2, "plans_reaching_goal": 1, "subgoal_distance": None, "planning_ms": [1.0]}
        line |= {f"strict_{name}": line[name] for name in ("outcome", "steps", "return")}
        rows.append(episode_row(cell, line))
    return as_table(rows)


def test_a_table_comes_back_as_it_was_and_has_the_same_bytes(tmp_path: Path) -> None:
    for name in ("one", "other"):
        write_table(tmp_path / name, played())
    pd.testing.assert_frame_equal(read_table(tmp_path / "one"), played())
    assert (tmp_path / "one").read_bytes() == (tmp_path / "other").read_bytes()
    for content in (b"no table", None):
        (tmp_path / "one").unlink()
        if content is not None:
            (tmp_path / "one").write_bytes(content)
        with pytest.raises(UserError, match="one is no table of episodes"):
            read_table(tmp_path / "one")


def test_a_table_is_drawn_as_far_as_the_options_choose() -> None:
    table = pd.concat([played(), played().assign(method="contact")])
    assert set(chosen_rows(table, compose("reproduce", "table=some.parquet"))["method"]) == {"cavin", "mpc"}
    some = compose("reproduce", "methods=[contact]", "rewards=[sparse]", "objects=[1]")
    assert chosen_rows(table, some)[["method", "reward", "objects"]].values.tolist() == [["contact", "sparse", 1]] * 2
    with pytest.raises(UserError, match="table=some.parquet has no episode of these methods"):
        chosen_rows(table, compose("reproduce", "table=some.parquet", "tasks=[crossing]"))


def test_figures_and_page_follow_from_the_table_and_have_the_same_bytes(tmp_path: Path) -> None:
    written = []
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        made = write_results(tmp_path / name, played(), "the command")
        written.append({path.name: path.read_bytes() for path in made})
    assert written[0] == written[1]
    pictures = {f"figure-paper-{one}.png" for one in ("strict", "published")}
    assert set(written[0]) == {"results.md", "statistics.json", *pictures}
    assert "100.0 % (20.7 to 100.0), n = 1" in written[0]["results.md"].decode()
    statistics = json.loads(written[0]["statistics.json"])
    assert set(statistics) == {"rates", "tests"} and len(statistics["tests"]) == 2 * 3


@pytest.mark.parametrize("only", [{"reward": "sparse"}, {"reward": "dense"}, {"objects": 1}, {"method": "mpc"}])
def test_a_part_of_a_table_has_its_figures(only: dict[str, object], tmp_path: Path) -> None:
    table = played()
    for name, value in only.items():
        table = table[table[name] == value]
    assert all(path.stat().st_size for path in write_results(tmp_path, table, "the command"))


def test_a_refused_command_leaves_no_folder_and_a_table_alone_is_drawn(shell: SimpleNamespace, tmp_path: Path) -> None:
    write_table(tmp_path / "some.parquet", played())
    refused = shell.run_command("reproduce", "table=absent.parquet", "output=drawn", folder=tmp_path)
    assert refused.status == 2 and len(refused.complaints) == 1
    assert not (tmp_path / "drawn").exists()
    drawn = shell.run_command("reproduce", "table=some.parquet", "output=drawn", folder=tmp_path)
    assert drawn.status == 0, drawn.errors
    assert "python -m cavin_pyro.reproduce table=some.parquet" in (tmp_path / "drawn" / "results.md").read_text()
