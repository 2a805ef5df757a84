"""What tests of devices need: a small dataset, the options that they train with, and tensors of records."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.utils._python_dispatch import _get_current_dispatch_mode

from cavin_pyro.config.composition import compose
from cavin_pyro.data.collection import CollectionConfig, collect
from cavin_pyro.evaluation import factory
from cavin_pyro.evaluation.factory import make_runner
from cavin_pyro.evaluation.rollout import Episode
from cavin_pyro.training import run
from cavin_pyro.training.run import train
from cavin_pyro.training.trainer import Trainer
from tests.cavin_pyro.devices import pretend

PUSHES = CollectionConfig(seed=5, steps=6, episodes_per_shard=10, minimum_objects=1, maximum_objects=2)
EPISODE = ["objects=2", "maximum_steps=2"]
TRAINING = [
    *("trainer.steps=4", "trainer.validate_every=2", "trainer.batch_size=8"),
    *("windows.minimum_move=0.0", "windows.negative_fraction=1.0"),
]


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The pretend device, which the commands choose within `PretendDevice`."""
    found = pretend.register()
    pretend.module.free = pretend.PLENTY
    for module in (factory, run):
        usual = module.choose_device
        monkeypatch.setattr(
            module,
            "choose_device",
            lambda name, usual=usual: found if _get_current_dispatch_mode() is not None else usual(name),
        )
    return found


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 20 episodes, to be read only."""
    folder = tmp_path_factory.mktemp("data") / "pushes"
    folder.mkdir()
    collect(PUSHES, folder, transitions=120, workers=1)
    return folder


def episode(*options: str, seed: int = 3) -> Episode:
    """The episode of `plan` with these options."""
    runner = make_runner(compose("plan", *EPISODE, *options))
    try:
        return runner.rollout(seed)
    finally:
        runner.env.close()


def trained(data: Path, output: Path, *options: str) -> dict[str, Tensor]:
    """What a training with these options leaves in its resume file, and the weights of its best checkpoint."""
    train(compose("train", f"data={data}", f"output={output}", *TRAINING, *options))
    best = {f"best.{name}": value for name, value in load_file(output / "checkpoint.safetensors").items()}
    return {**load_file(output / "resume.safetensors"), **best}


@contextmanager
def broken_after(step: int) -> Iterator[None]:
    """Interrupt a training in its step of this number; it has validated at step 2."""
    usual = Trainer._update

    def update(trainer: Trainer) -> float:
        if trainer.step == step:
            raise KeyboardInterrupt
        return usual(trainer)

    with pytest.MonkeyPatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(Trainer, "_update", update)
        yield


def tensors(record: Any) -> list[Tensor]:
    """All tensors of a record of records, in order."""
    if isinstance(record, tuple):
        return [tensor for part in record for tensor in tensors(part)]
    return [] if record is None else [record]
