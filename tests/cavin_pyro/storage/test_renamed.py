"""Checkpoints whose configuration has old names."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import class_of
from cavin_pyro.storage.checkpoint import default_checkpoint, load_checkpoint, save_checkpoint
from cavin_pyro.storage.renamed import CLASSES, rename, renamed, rewrite


@pytest.fixture
def old_config(small: SimpleNamespace) -> dict[str, Any]:
    config = small.config()
    config["prior"] = {"_target_": "models.priors.StandardPrior"}
    config["trainer"] = {"steps": 5, "batches": "alike", "products": "bfloat16", "patience": 3}
    config["windows"] = {"without": ["mug"], "quiet_fraction": 0.5}
    return config


@pytest.fixture
def old_checkpoint(small: SimpleNamespace, old_config: dict[str, Any], tmp_path: Path) -> Path:
    path = tmp_path / "before.safetensors"
    save_checkpoint(path, parts=small.parts(), config=old_config, provenance={"step": 7})
    return path


def weights(path: Path) -> bytes:
    content = path.read_bytes()
    return content[8 + int.from_bytes(content[:8], "little") :]


def test_old_names_give_one_line_with_the_new_names_and_the_command_that_rewrites(old_checkpoint: Path) -> None:
    with pytest.raises(UserError) as refused:
        load_checkpoint(old_checkpoint)
    line = str(refused.value)
    for change in (
        "models.priors.StandardPrior -> models.priors.standard.StandardPrior",
        "trainer.batches=alike -> trainer.batches=bucketed",
        "trainer.products -> trainer.matmul_precision",
        "windows.without -> windows.held_out_objects",
        "windows.quiet_fraction -> windows.negative_fraction",
    ):
        assert change in line
    assert line.endswith(f"rewrite it with python -m cavin_pyro.storage.renamed {old_checkpoint}")
    assert "\n" not in line


def test_the_command_rewrites_names_and_leaves_the_weights_and_everything_else(
    old_checkpoint: Path, old_config: dict[str, Any]
) -> None:
    before = weights(old_checkpoint)
    command = [sys.executable, "-m", "cavin_pyro.storage.renamed", str(old_checkpoint)]
    assert subprocess.run(command, capture_output=True, text=True, check=False).returncode == 0
    assert weights(old_checkpoint) == before
    checkpoint = load_checkpoint(old_checkpoint)
    assert checkpoint.provenance == {"step": 7}
    trainer = {"steps": 5, "batches": "bucketed", "matmul_precision": "bfloat16", "patience": 3}
    assert checkpoint.config["trainer"] == trainer
    assert list(checkpoint.config["trainer"]) == list(trainer)
    assert checkpoint.config["windows"] == {"held_out_objects": ["mug"], "negative_fraction": 0.5}
    assert checkpoint.config["model"] == old_config["model"]
    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.stdout.endswith("all names are up to date\n")


def test_a_file_that_is_no_checkpoint_does_not_change(tmp_path: Path) -> None:
    for content in (b"", b"hello", b"\x02\0\0\0\0\0\0\0{}", torch.zeros(3).numpy().tobytes()):
        path = tmp_path / "other.safetensors"
        path.write_bytes(content)
        with pytest.raises(UserError, match="is no checkpoint of cavin_pyro"):
            rewrite(path)
        assert path.read_bytes() == content
    with pytest.raises(UserError, match="cannot be read"):
        rewrite(tmp_path / "none.safetensors")


def test_every_new_name_is_a_class() -> None:
    assert all(isinstance(class_of({"_target_": new}), type) for new in CLASSES.values())


@pytest.mark.parametrize("path", sorted(default_checkpoint().parent.glob("*.safetensors")), ids=lambda path: path.stem)
def test_shipped_checkpoints_have_current_names(path: Path) -> None:
    assert not renamed(load_checkpoint(path).config)


def test_a_configuration_with_current_names_does_not_change(small: SimpleNamespace) -> None:
    config = small.config()
    rename(config)
    assert config == small.config()
