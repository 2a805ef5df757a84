"""`reproduce`, from an empty folder to the figure, in its smallest size."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from filelock import FileLock

from cavin_pyro.config.errors import UserError, WorkerError
from cavin_pyro.reproduction import stages
from cavin_pyro.reproduction.stages import Stage, run_stages
from cavin_pyro.reproduction.table import read_table
from cavin_pyro.storage.files import output_folder

WHOLE = ("scale=minimal", "methods=[mpc]", "planners=[paper]", "workers=1", "output=whole")
TWO_METHODS = ("scale=minimal", "methods=[cavin,mpc]", "planners=[paper]")  # in make soak
RESULTS = ("episodes.parquet", "statistics.json", "figure-paper-strict.png", "figure-paper-published.png")


def contents(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in RESULTS}


@pytest.fixture(scope="module")
def reproduced(shell: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which WHOLE has run once."""
    folder = tmp_path_factory.mktemp("reproduced")
    first = shell.run_command("reproduce", *WHOLE, folder=folder, stages="forked")
    assert first.status == 0, first.errors
    assert "whole/results.md" in first.output and "whole/figure-paper-strict.png" in first.output
    return folder


def test_a_reproduction_goes_from_nothing_to_its_figures_and_is_never_done_again(
    shell: SimpleNamespace, reproduced: Path
) -> None:
    home = reproduced / "whole"
    made = contents(home)
    finished = {path: path.stat().st_mtime_ns for path in home.rglob("training.png")}
    episodes = {path: path.read_bytes() for path in home.rglob("episodes.jsonl")}
    assert len(finished) == 1 and len(episodes) == 3
    cut = sorted(episodes)[0]
    cut.write_bytes(episodes[cut][:-20])  # as a machine that lost its power leaves it
    for name in RESULTS:
        (home / name).unlink()
    again = shell.run_command("reproduce", *WHOLE, folder=reproduced, stages="forked")
    assert again.status == 0, again.errors
    assert contents(home) == made
    assert finished == {path: path.stat().st_mtime_ns for path in home.rglob("training.png")}
    other = shell.run_command("reproduce", "scale=smoke", "output=whole", folder=reproduced)
    assert other.status == 2 and "holds a run with" in other.complaints[0]


@pytest.mark.soak
def test_a_reproduction_grows_and_extends_a_table_and_takes_models_that_are_there(
    shell: SimpleNamespace, reproduced: Path, tmp_path: Path
) -> None:
    shutil.copytree(reproduced / "whole", tmp_path / "whole")
    home, made = tmp_path / "whole", contents(tmp_path / "whole")
    episodes = {path: path.read_bytes() for path in home.rglob("episodes.jsonl")}
    later = {"folder": tmp_path, "stages": "forked"}
    more = shell.run_command("reproduce", *WHOLE, "bottom_episodes=2", **later)
    assert more.status == 0, more.errors
    longer = {path: path.read_bytes() for path in home.rglob("episodes.jsonl")}
    assert all(longer[path].startswith(kept) for path, kept in episodes.items())
    assert sum(text.count(b"\n") for text in longer.values()) == 3 + 1
    *before, last = (run["command"].split()[-1] for run in json.loads((home / "provenance.json").read_text()))
    assert {*before} == {"output=whole"} and last == "bottom_episodes=2"
    models = tmp_path / "models"
    models.mkdir()
    shutil.copy(home / "train" / "mpc-0" / "checkpoint.safetensors", models / "mpc-0.safetensors")
    trained = shell.run_command("reproduce", *WHOLE[:-1], "models=models", "output=trained", **later)
    assert trained.status == 0, trained.errors
    assert not (tmp_path / "trained" / "data").exists() and not (tmp_path / "trained" / "train").exists()
    assert contents(tmp_path / "trained") == made
    extended = ("models=models", "bottom_episodes=3", "extends=whole/episodes.parquet", "output=extended")
    joined = shell.run_command("reproduce", *WHOLE[:-1], *extended, **later)
    assert joined.status == 0, joined.errors
    rows, known = (read_table(path / "episodes.parquet") for path in (tmp_path / "extended", home))
    assert len(rows) == 5 and [row for row in rows if row in known] == known
    run = [path.read_text().splitlines() for path in (tmp_path / "extended").rglob("episodes.jsonl")]
    assert sum(map(len, run)) == 5 - 4  # the other four are those of the table, and were not run again
    records = json.loads((tmp_path / "extended" / "provenance.json").read_text())
    assert [one["command"].split()[-1] for one in records[-2:]] == ["bottom_episodes=2", "output=extended"]
    strange = shell.run_command("reproduce", "scale=smoke", *extended[2:3], "output=strange", folder=tmp_path)
    assert (
        strange.status == 2
        and "has scene 50000 of mpc in clearing, which no run with scale=smoke has" in (strange.complaints[0])
    )
    lacking = shell.run_command("reproduce", "scale=minimal", "models=models", "output=lacking", folder=tmp_path)
    expected = "models=models holds no cavin-0.safetensors: choose other methods, or train it"
    assert lacking.status == 2 and expected in lacking.complaints[0]


@pytest.mark.soak  # here each stage starts with an interpreter of its own
def test_a_reproduction_killed_three_times_equals_an_unbroken_one(shell: SimpleNamespace, tmp_path: Path) -> None:
    whole = shell.run_command("reproduce", *TWO_METHODS, "workers=1", "output=whole", folder=tmp_path)
    assert whole.status == 0, whole.errors
    broken = (*TWO_METHODS, "output=broken")
    reached = ("data/metadata.json", "train/cavin-0/metrics.csv", "evaluate/*/episodes.jsonl")
    for pattern in reached:
        process = shell.start_command("reproduce", *broken, folder=tmp_path, quiet=True)
        while process.poll() is None and not any((tmp_path / "broken").glob(pattern)):
            time.sleep(0.05)
        process.kill()
        assert process.wait() == -signal.SIGKILL
        wait_for_orphans(tmp_path / "broken")
    done = shell.run_command("reproduce", *broken, folder=tmp_path)
    assert done.status == 0, done.errors
    assert contents(tmp_path / "broken") == contents(tmp_path / "whole")


def wait_for_orphans(home: Path) -> None:
    """Processes of a killed run hold their folders until they end."""
    for path in home.rglob(".lock"):
        with FileLock(path):
            pass


def test_a_stage_that_another_process_writes_is_refused(tmp_path: Path) -> None:
    stage = Stage("collect", ("transitions=1",), tmp_path / "data", "statistics.png", 1.0)
    with output_folder(stage.folder), pytest.raises(UserError, match=r"failed: .*data is being written by process \d+"):
        stage.run()


class Sleeping(Stage):
    """A command that sleeps, and ends otherwise only by a signal."""

    @property
    def line(self) -> str:
        return f"python -c 'import time; time.sleep({self.seconds})'"


def test_an_interruption_reaches_the_stages_that_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages, "POLLING_SECONDS", 0.2)

    def interrupt() -> None:
        raise KeyboardInterrupt

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_stages([Sleeping("", (), tmp_path / name, "never", 60.0) for name in "abc"], 2, interrupt)
    assert time.monotonic() - began < 30
    assert not (tmp_path / "c").exists()  # it had to wait, and does not begin


class Failing(Stage):
    """A command that fails at once."""

    @property
    def line(self) -> str:
        return "python -c 'import sys; sys.exit(1)'"


def test_an_interruption_after_a_failure_reaches_the_stages_that_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages, "POLLING_SECONDS", 0.2)
    failed = tmp_path / "a" / "log.txt"
    calls = []

    def interrupt() -> None:
        calls.append(failed.exists())
        if len(calls) > 10:
            raise KeyboardInterrupt

    began = time.monotonic()
    some = [
        Failing("", (), tmp_path / "a", "never", 1.0),
        *(Sleeping("", (), tmp_path / name, "never", 60.0) for name in "bc"),
    ]
    with pytest.raises(KeyboardInterrupt):
        run_stages(some, 2, interrupt)
    assert time.monotonic() - began < 30
    assert not (tmp_path / "c").exists()  # it had to wait, and does not begin after a failure


def test_a_failure_is_told_when_the_stages_that_run_have_ended(tmp_path: Path) -> None:
    some = [Failing("", (), tmp_path / "a", "never", 1.0), Sleeping("", (), tmp_path / "b", "never", 0.5)]
    some.append(Sleeping("", (), tmp_path / "c", "never", 60.0))
    with pytest.raises(UserError, match=r"sys.exit\(1\)' failed"):
        run_stages(some, 2, lambda: None)
    assert not (tmp_path / "c").exists()


def test_a_killed_stage_is_told_with_its_signal(tmp_path: Path) -> None:
    def kill(process: subprocess.Popen[bytes]) -> None:
        process.kill()

    with pytest.raises(WorkerError, match=r"sleep\(60.0\)' was killed by signal 9; rerun"):
        Sleeping("", (), tmp_path / "a", "never", 60.0).run(kill)


def test_a_failed_stage_is_told_with_its_command_and_its_last_line(tmp_path: Path) -> None:
    stage = Stage("train", ("data=nowhere", "trainer.steps=0"), tmp_path / "train", "training.png", 1.0)
    expected = (
        r"train data=nowhere trainer.steps=0 output=.* failed: trainer.steps must be at least 1, not 0 \(.*log.txt\)"
    )
    with pytest.raises(Exception, match=expected):
        run_stages([stage], 1, lambda: None)
    shutil.rmtree(stage.folder)
