"""The command that calibrates, from a checkpoint and a dataset to the checkpoint with the repaired guide."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from cavin_pyro.criticism.loading import load_programs
from cavin_pyro.data.dataset import shard_path
from cavin_pyro.storage.checkpoint import load_checkpoint, save_checkpoint
from cavin_pyro.storage.files import file_digest
from cavin_pyro.storage.geometry import geometry_of
from tests.cavin_pyro.conftest import WINDOWS

OPTIONS = ["steps=3", "batch_size=8", "windows=6", "samples=4", "repeats=2"]


def test_only_the_guide_changes_and_the_checkpoint_says_so(
    small: SimpleNamespace, pushes: Path, shell: SimpleNamespace, tmp_path: Path
) -> None:
    trained = tmp_path / "trained.safetensors"
    config = {**small.config(), "windows": WINDOWS, "seed": 1}
    save_checkpoint(trained, parts=small.parts(), config=config, provenance={"step": 7})
    line = [f"checkpoint={trained}", f"data={pushes}", "output=out", *OPTIONS]
    done = shell.run_command("calibrate", *line, folder=tmp_path)
    assert done.status == 0, done.errors
    assert "90 % intervals of c cover" in done.output and "real windows: -ELBO" in done.output
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "calibration.json",
        "checkpoint.safetensors",
        "config.yaml",
    }
    path = tmp_path / "out" / "checkpoint.safetensors"
    before, after = load_checkpoint(trained), load_checkpoint(path)
    changed = {name for name, value in before.tensors.items() if not torch.equal(value, after.tensors[name])}
    assert changed and all(name.startswith("guide.") for name in changed)
    assert before.tensors.keys() == after.tensors.keys()
    assert before.config == after.config
    assert after.provenance["step"] == 7
    (record,) = after.provenance["calibrated"]
    assert record["steps"] == 3 and record["wake_weight"] == 0.03
    assert record["checkpoint"] == file_digest(trained)
    assert record["command"].startswith("python -m cavin_pyro")
    assert record["before"]["codes"].keys() == record["after"]["codes"].keys() == {"c", "z"}
    assert record["after"]["simulated"] == 2 * record["after"]["windows"]
    assert record["before"]["minus_elbo"] != record["after"]["minus_elbo"]
    losses = json.loads((tmp_path / "out" / "calibration.json").read_text())["losses"]
    assert [row["step"] for row in losses] == [1, 2, 3]
    load_programs(after, path)
    geometry_of(after, path)
    again = shell.run_command("calibrate", *line, folder=tmp_path)
    assert again.status == 0, again.errors
    assert load_checkpoint(path).tensors.keys() == after.tensors.keys()
    assert all(torch.equal(value, after.tensors[name]) for name, value in load_checkpoint(path).tensors.items())


def test_a_model_without_codes_is_refused_in_one_line(
    small: SimpleNamespace, pushes: Path, shell: SimpleNamespace, tmp_path: Path
) -> None:
    trained, data = tmp_path / "trained.safetensors", shutil.copytree(pushes, tmp_path / "data")
    shard_path(data, 1).unlink()  # which would be told if the data were read first
    small.save_baseline(trained, "dynamics", windows=WINDOWS, seed=1)
    done = shell.run_command("calibrate", f"checkpoint={trained}", f"data={data}", "output=out", folder=tmp_path)
    assert done.status == 2
    assert len(done.complaints) == 1
    assert "DynamicsModel, which has no codes, so that there is no guide to calibrate" in done.errors
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "option, said",
    [
        ("steps=0", "steps must be at least 1, not 0"),
        ("wake_weight=-1", "wake_weight must be at least 0"),
        ("samples=1", "samples must be at least 2, not 1"),
        ("repeats=0", "repeats must be at least 1, not 0"),
        ("data=nowhere", "python -m cavin_pyro.collect"),
    ],
)
def test_bad_input_ends_in_one_line(option: str, said: str, shell: SimpleNamespace, tmp_path: Path) -> None:
    done = shell.run_command("calibrate", option, "output=out", folder=tmp_path)
    assert (done.status, said in done.errors) == (2, True), done.errors
    assert not (tmp_path / "out").exists()
