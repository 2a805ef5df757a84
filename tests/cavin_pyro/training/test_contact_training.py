"""Dynamics that see contact, from training over a checkpoint to planning."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.factory import make_runner
from cavin_pyro.storage.checkpoint import load_checkpoint
from cavin_pyro.storage.geometry import geometry_of
from cavin_pyro.training.run import train
from models.likelihoods import PredictedScales
from models.networks.contact.dynamics import ContactDynamics
from models.networks.outline import Outline

SMALL = (
    *("model.width=8", "guide.width=8", "dynamics.object_width=16", "dynamics.pair_width=4"),
    *("trainer.steps=30", "trainer.validate_every=10", "trainer.batch_size=16", "trainer.validation_windows=32"),
    *("trainer.learning_rate=1e-2", "windows.minimum_move=0.001", "windows.validation_fraction=0.4"),
)


@pytest.fixture(scope="module")
def folder(pushes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("contact")
    shutil.copytree(pushes, home / "pushes")  # features go there
    return home


def test_what_is_trained_is_what_plans(folder: Path) -> None:
    parts = ("geometry=outline", "dynamics=contact", "scales=predicted")
    run = train(compose("train", *parts, *SMALL, f"data={folder / 'pushes'}", f"output={folder / 'run'}"))
    assert run.rows[-1]["validation_loss"] < run.rows[0]["validation_loss"]
    path = folder / "run" / "checkpoint.safetensors"
    assert isinstance(geometry_of(load_checkpoint(path), path), Outline)

    small = ("planner=paper", "planner.samples=8", "planner.horizon=6", "maximum_steps=1", "objects=2")
    runner = make_runner(compose("evaluate", f"checkpoint={path}", *small))
    model = runner.planner.model
    assert isinstance(model.dynamics, ContactDynamics)
    assert isinstance(model.scales, PredictedScales)
    assert torch.equal(model.dynamics.head.weight, load_checkpoint(path).tensors["model.dynamics.head.weight"])
    assert runner.rollout(0).outcome in ("timeout", "success", "violation", "fall")
    runner.env.close()


def test_features_of_another_kind_are_refused_before_training(folder: Path) -> None:
    with pytest.raises(UserError, match="ContactDynamics reads the features of Outline, not of PointNet"):
        train(compose("train", "dynamics=contact", *SMALL, f"data={folder / 'pushes'}", f"output={folder / 'other'}"))
    assert not (folder / "other").exists()
