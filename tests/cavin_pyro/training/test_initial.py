"""Training that goes on from a checkpoint, in some of its parts."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.checkpoint import checkpoint_bytes, load_checkpoint
from cavin_pyro.storage.files import file_digest
from cavin_pyro.training.run import train

PARTS = ("geometry=outline", "dynamics=contact", "scales=predicted")
SMALL = (
    *("model.width=8", "guide.width=8", "dynamics.object_width=16", "dynamics.pair_width=4"),
    *("trainer.steps=4", "trainer.validate_every=2", "trainer.batch_size=16", "trainer.validation_windows=32"),
    *("trainer.learning_rate=1e-2", "windows.minimum_move=0.001", "windows.validation_fraction=0.4"),
)


@pytest.fixture(scope="module")
def folder(pushes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("initial")
    shutil.copytree(pushes, home / "pushes")  # features go there
    run(home, "first")
    return home


def run(home: Path, name: str, *options: str) -> Path:
    train(compose("train", *PARTS, *SMALL, f"data={home / 'pushes'}", f"output={home / name}", *options))
    return home / name / "checkpoint.safetensors"


def test_parts_that_are_not_trained_stay_bit_for_bit(folder: Path) -> None:
    first = folder / "first" / "checkpoint.safetensors"
    second = run(
        folder, "dynamics", f"initial={first}", "trained=[dynamics]", "objective=rollout", "trainer.reflect=true"
    )
    before, after = load_checkpoint(first), load_checkpoint(second)
    changed = {name.split(".")[1] for name, value in before.tensors.items() if not value.equal(after.tensors[name])}
    assert changed == {"dynamics"}
    assert after.provenance["initial"]["sha256"] == file_digest(first)
    assert after.provenance["initial"]["provenance"] == before.provenance


def test_without_names_all_parts_go_on_from_the_checkpoint(folder: Path) -> None:
    first = folder / "first" / "checkpoint.safetensors"
    slow = run(folder, "all", f"initial={first}", "trainer.learning_rate=1e-9")
    for name, value in load_checkpoint(first).tensors.items():
        torch.testing.assert_close(load_checkpoint(slow).tensors[name], value, atol=1e-6, rtol=0)


def test_what_a_calibration_has_found_stays_where_f_alone_is_trained(folder: Path) -> None:
    first = load_checkpoint(folder / "first" / "checkpoint.safetensors")
    calibrated = folder / "calibrated.safetensors"
    records = {**first.provenance, "calibrated": [{"steps": 3}]}
    calibrated.write_bytes(checkpoint_bytes(first.tensors, first.config, records))
    for number, (trained, kept) in enumerate({"[dynamics]": True, "[guide]": False, "[]": False}.items()):
        path = run(folder, f"after-{number}", f"initial={calibrated}", f"trained={trained}", "trainer.steps=2")
        assert (load_checkpoint(path).provenance.get("calibrated") == [{"steps": 3}]) is kept


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["trained=[wheels]"], "trained has 'wheels', which is no part of this model: choose from encoder, dynamics, "),
        (["initial={first}", "model.width=16"], "the configuration that it was trained with: model.width=8"),
        (
            ["initial={first}", "dynamics.reach_margin=null", "dynamics.pair_width=8"],
            "that it was trained with: dynamics.pair_width=4 dynamics.reach_margin=0.015",
        ),
        (["initial=nothing"], "unknown checkpoint 'nothing': choose from cavin"),
        (
            ["initial=cavin"],
            "model.width=64 geometry=pointnet dynamics=paper prior=conditional scales=fixed guide.width=64",
        ),
    ],
)
def test_what_cannot_be_trained_on_gives_its_line_and_writes_nothing(folder: Path, options: list, said: str) -> None:
    first = folder / "first" / "checkpoint.safetensors"
    with pytest.raises(UserError) as error:
        run(folder, "bad", *(option.format(first=first) for option in options))
    assert said in str(error.value)
    assert not (folder / "bad").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "those of PointNet have none: pass geometry=outline, or leave trainer.reflect"),
        (["geometry=outline", "guide=auto_normal"], "trainer.reflect needs a guide that infers any window"),
    ],
)
def test_windows_are_mirrored_only_where_that_is_known(folder: Path, options: list, said: str) -> None:
    where = (f"data={folder / 'pushes'}", f"output={folder / 'bad'}")
    with pytest.raises(UserError, match=said):
        train(compose("train", "trainer.reflect=true", *SMALL[-2:], *where, *options))
    assert not (folder / "bad").exists()
