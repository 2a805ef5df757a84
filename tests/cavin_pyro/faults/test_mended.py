"""What faults of the disk broke before, each on its own: without the library that makes them, so on every machine."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from cavin_pyro.criticism.sections import run_sections
from cavin_pyro.data import collection
from cavin_pyro.data.features import ABANDONED_SECONDS, geometry_fingerprint, shard_features
from cavin_pyro.reproduction import pipeline
from cavin_pyro.reproduction.cells import evaluations
from cavin_pyro.reproduction.scales import SCALES
from cavin_pyro.reproduction.stages import Stage, run_stages
from cavin_pyro.storage.files import output_folder
from cavin_pyro.storage.progress import ScalarLog
from cavin_pyro.visualization import video
from models.networks.pointnet import PointNet
from tests.cavin_pyro.faults.comparison import results

needs_dev_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, a full disk")
ABANDONED = ".elbo.cavin-0123abcd.partial.json"


def shards_timed(folder: Path) -> list[str]:
    return [line.partition(",")[0] for line in (folder / "timing.csv").read_text().splitlines()[1:]]


def test_times_of_collecting_are_neither_lost_nor_doubled_nor_joined(
    small: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:  # killed between the row of the first shard and the metadata that count it
        patched.setattr(collection, "_write", interrupt)
        with pytest.raises(KeyboardInterrupt):
            collection.collect(small.pushes, tmp_path, transitions=1, workers=1)
    with monkeypatch.context() as patched:  # killed while the row of the second shard is written
        collection.collect(small.pushes, tmp_path, transitions=1, workers=1)
        with open(tmp_path / "timing.csv", "a") as file:
            file.write("1,2")
    collection.collect(small.pushes, tmp_path, transitions=30, workers=1)
    assert shards_timed(tmp_path) == ["0", "1"]


def test_scalars_are_on_disk_at_once_and_a_resumed_run_shows_those_that_were_lost(tmp_path: Path) -> None:
    rows = [{"step": float(step), "validation_loss": 10.0 - step} for step in (2, 4, 6)]
    with ScalarLog(tmp_path / "killed") as log:
        log.add(rows[0])
        (path,) = (tmp_path / "killed").iterdir()
        steps = [event.step for event in EventFileLoader(str(path)).Load() if event.summary.value]
        assert steps == [2]
        log.add({"step": 4.0, "validation_loss": -1.0})  # of a validation that the resume file does not know
    with ScalarLog(tmp_path / "killed", rows[:2]) as log:
        log.add(rows[2])
    with ScalarLog(tmp_path / "whole") as log:
        for row in rows:
            log.add(row)
    shown = results(tmp_path)
    assert shown["killed"] == shown["whole"]
    assert shown["whole"]["validation_loss at 4"] == [6.0]


@needs_dev_full
def test_a_full_disk_under_tensorboards_file_is_an_error_of_the_disk(tmp_path: Path) -> None:
    with open("/dev/full", "ab", buffering=0) as full, ScalarLog(tmp_path) as log:
        os.dup2(full.fileno(), log._file.fileno())
        with pytest.raises(OSError) as caught:
            log.add({"step": 1.0})
        assert caught.value.errno == errno.ENOSPC
        os.dup2(os.open(os.devnull, os.O_WRONLY), log._file.fileno())  # which can be closed


@needs_dev_full
def test_ffmpeg_leaves_it_to_the_command_to_tell_of_a_full_disk(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "full.mp4").symlink_to("/dev/full")
    writer = video._open_writer(tmp_path / "full.mp4", 10)
    with suppress(OSError):  # or it ends only when it is closed
        writer.append_data(np.zeros((64, 64, 3), np.uint8))
    writer.close()
    assert capfd.readouterr().err == ""


def test_a_run_that_is_killed_as_it_begins_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touch = Path.touch

    def interrupt(path: Path) -> None:
        touch(path)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Path, "touch", interrupt)
        with pytest.raises(KeyboardInterrupt), output_folder(tmp_path):
            pass
    with output_folder(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_half_written_sections_and_episodes_are_cleared_away_below_the_output_folder(tmp_path: Path) -> None:
    for folder in ("sections", "cell"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / ABANDONED).touch()
        (tmp_path / folder / ".notes.partial").touch()  # a user's
    assert run_sections([], None, {}, tmp_path, "") == []  # type: ignore[arg-type]
    pipeline._made(tmp_path / "cell")
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
    assert left == ["cell/.notes.partial", "sections/.notes.partial"]


def test_half_written_features_are_cleared_away_when_no_training_can_be_writing_them(own_pushes: Path) -> None:
    geometry = PointNet()
    fingerprint = geometry_fingerprint(geometry)
    folder = own_pushes / f"features-{fingerprint}"
    folder.mkdir()
    old, young = (folder / f".episodes-00000.cavin-{digits}.partial.h5" for digits in ("00000000", "11111111"))
    for path in (old, young):
        path.touch()
    past = young.stat().st_mtime - ABANDONED_SECONDS - 60
    os.utime(old, (past, past))
    shard_features(own_pushes, 0, geometry, fingerprint)
    assert {path.name for path in folder.iterdir()} == {"episodes-00000.h5", young.name}


def test_a_stage_that_was_killed_after_its_last_file_keeps_its_results_alone(tmp_path: Path) -> None:
    for name in ("training.png", ".lock", ".metrics.cavin-0123abcd.partial.csv"):
        (tmp_path / name).touch()
    run_stages([Stage("train", (), tmp_path, "training.png", 1.0)], 1, lambda: None)
    assert [path.name for path in tmp_path.iterdir()] == ["training.png"]


def test_the_configuration_of_a_cell_is_complete_or_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A half of one would have stayed, because it is written only once."""

    def interrupt(descriptor: int) -> None:
        raise KeyboardInterrupt

    own = list(evaluations(SCALES["minimal"], ["mpc"], ["paper"]))[:1]
    folder = pipeline._made(pipeline.evaluation_folder(tmp_path, own[0]))
    models = {own[0]: tmp_path / "checkpoint.safetensors"}
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", interrupt)
        with pytest.raises(KeyboardInterrupt):
            list(pipeline._configurations(SCALES["minimal"], own, tmp_path, models, "cpu"))
    assert not list(folder.iterdir())
    list(pipeline._configurations(SCALES["minimal"], own, tmp_path, models, "cpu"))
    assert [path.name for path in folder.iterdir()] == ["config.yaml"]
