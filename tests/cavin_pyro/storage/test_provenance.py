from __future__ import annotations

import datetime
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from cavin_pyro import __version__
from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.data.windows import load_windows
from cavin_pyro.storage.checkpoint import save_checkpoint
from cavin_pyro.storage.geometry import pointnet_provenance
from cavin_pyro.storage.provenance import provenance
from cavin_pyro.training.run import training_provenance


def test_provenance_names_command_versions_and_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/somewhere/cavin_pyro/plan.py", "task=crossing", "output=a b"])
    record = provenance()
    assert json.loads(json.dumps(record)) == record
    assert record["program"] == f"cavin_pyro {__version__}"
    assert record["command"] == "python -m cavin_pyro.plan task=crossing 'output=a b'"
    assert record["packages"]["torch"] == torch.__version__
    age = datetime.datetime.now(datetime.timezone.utc) - datetime.datetime.fromisoformat(record["date"])
    assert datetime.timedelta(seconds=-2) < age < datetime.timedelta(minutes=1)
    monkeypatch.setattr(sys, "argv", ["/usr/bin/cavin-plan"])
    assert provenance()["command"] == "python -m cavin_pyro.plan"


def test_the_provenance_of_a_trained_model_names_its_data_and_pointnet(
    small: SimpleNamespace, own_pushes: Path, tmp_path: Path
) -> None:
    parts, path = small.parts(), tmp_path / "pointnet.safetensors"
    save_checkpoint(path, parts={"pointnet": parts["pointnet"]}, config={}, provenance={"command": "pretrain"})
    config = WindowConfig(minimum_move=0.005, validation_fraction=0.3)
    windows = load_windows([own_pushes], parts["pointnet"], config)
    record = training_provenance([own_pushes], pointnet_provenance(path), windows)
    ((data),) = record["data"]
    assert (data["transitions"], data["episodes"], data["configuration"]["seed"]) == (72, 12, 3)
    assert record["pointnet"] == {"command": "pretrain"}
    assert record["training_windows"] == len(windows.training) > 0
    # A PointNet out of a whole checkpoint keeps its own record.
    save_checkpoint(path, parts={"pointnet": parts["pointnet"]}, config={}, provenance=record)
    assert training_provenance([own_pushes], pointnet_provenance(path), windows)["pointnet"] == {"command": "pretrain"}
    assert json.loads(json.dumps(record)) == record
