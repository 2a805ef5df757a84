"""Whole trainings from the configuration: of an f that sees contact, over a checkpoint, with an automatic guide."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pyro
import pytest
import torch
from pyro.infer.autoguide import AutoNormal
from torch import nn

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.windows import WindowTable
from cavin_pyro.envs.tabletop.sensors.camera import Camera
from cavin_pyro.envs.tabletop.workspace import REACH_HIGH, REACH_LOW, SPACE, TABLE_HIGH, TABLE_LOW
from cavin_pyro.evaluation.factory import make_runner
from cavin_pyro.guides.automatic import AutomaticGuide
from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.flat import FlatModel
from cavin_pyro.models.networks.contact.dynamics import ContactDynamics
from cavin_pyro.models.networks.contact.geometry import REACH, endpoints
from cavin_pyro.models.networks.outline import Outline
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.models.state import State, Window
from cavin_pyro.storage.checkpoint import load
from cavin_pyro.storage.files import file_digest
from cavin_pyro.training.run import fit, train
from cavin_pyro.training.trainer import Trainer, reflect

CONTACT = ("geometry=outline", "dynamics=contact", "scales=predicted", "dynamics.object_width=16")
SMALL = (
    *("model.width=8", "trainer.batch_size=16", "trainer.validation_windows=32", "trainer.learning_rate=1e-2"),
    *("trainer.steps=4", "trainer.validate_every=2", "windows.minimum_move=0.001", "windows.validation_fraction=0.4"),
)


@pytest.fixture(scope="module")
def folder(pushes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("train")
    shutil.copytree(pushes, home / "pushes")  # features go there
    run(home, "first", *CONTACT, "guide.width=8")
    return home


def run(home: Path, name: str, *options: str) -> Trainer:
    return train(compose("train", *SMALL, f"data={home / 'pushes'}", f"output={home / name}", *options))


def test_what_is_trained_is_what_plans(folder: Path) -> None:
    path = folder / "first" / "checkpoint.safetensors"
    assert isinstance(load(path).geometry, Outline)
    small = ("planner=paper", "planner.samples=8", "planner.horizon=6", "maximum_steps=1", "objects=2")
    runner = make_runner(compose("evaluate", f"checkpoint={path}", *small))
    model = runner.planner.model
    assert isinstance(model.dynamics, ContactDynamics)
    assert torch.equal(model.dynamics.head.weight, load(path).tensors["model.dynamics.head.weight"])
    assert runner.rollout(0).outcome in ("timeout", "success", "violation", "fall")
    runner.env.close()


def test_parts_that_are_not_trained_stay_bit_for_bit(folder: Path) -> None:
    first = load(folder / "first" / "checkpoint.safetensors")
    more = (*CONTACT, "guide.width=8", f"initial={first.path}", "objective=rollout", "trainer.reflect=true")
    for trained, part in (("[dynamics]", "dynamics"), ("[]", None)):
        after = load(run(folder, f"of-{part}", f"trained={trained}", *more).folder / "checkpoint.safetensors")
        changed = {name.split(".")[1] for name, value in first.tensors.items() if not value.equal(after.tensors[name])}
        assert changed == {"dynamics"} if part else len(changed) > 3
        assert after.provenance["initial"] == {"sha256": file_digest(first.path), "provenance": first.provenance}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["dynamics=contact"], "ContactDynamics reads the features of Outline, not of PointNet"),
        ([*CONTACT, "trained=[wheels]"], "trained has 'wheels', which is no part of this model: choose from encoder, "),
        ([*CONTACT, "initial={first}", "model.width=16"], "is of another architecture: model."),
        (["initial=pusht"], "is of another world than the data"),
        (["initial=nothing"], "unknown checkpoint 'nothing': choose from cavin"),
        (["trainer.reflect=true"], "PointNet has none: pass geometry=outline, or leave trainer.reflect"),
        (["geometry=outline", "trainer.reflect=true", "guide=auto_normal"], "trainer.reflect needs a guide that"),
        (["guide=auto_normal", "objective=mean_field_elbo"], "samples auxiliary sites, which this objective leaves"),
    ],
)
def test_what_cannot_be_trained_gives_its_line_and_writes_nothing(folder: Path, options: list, said: str) -> None:
    first = folder / "first" / "checkpoint.safetensors"
    with pytest.raises(UserError) as error:
        run(folder, "bad", *(option.format(first=first) for option in options))
    assert said in str(error.value) and "\n" not in str(error.value)
    assert not (folder / "bad").exists()


def test_a_finished_training_is_extended_and_what_changes_its_meaning_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for options in ((), (), ("trainer.steps=6", "trainer.patience=30")):
        grown = run(folder, "grown", *options)
    assert capsys.readouterr().err.count("training: finished at step 4") == 1
    whole = run(folder, "whole", "trainer.steps=6")
    assert grown.step == 6 and [row["validation_loss"] for row in grown.rows] == [
        row["validation_loss"] for row in whole.rows
    ]
    for option in ("trainer.steps=2", "trainer.batch_size=8", "seed=1", "trainer.schedule=cosine"):
        with pytest.raises(UserError, match=option.partition("=")[0]):
            run(folder, "grown", "trainer.steps=6", option)


@pytest.mark.parametrize("guide", ["auto_normal", "auto_iaf"])
def test_an_automatic_guide_learns_its_windows_resumes_and_says_what_it_is(
    guide: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = (f"guide={guide}", "trainer.batch_size=5")
    whole = run(folder, f"{guide}-whole", *options, "trainer.steps=8")
    assert "5 of " in capsys.readouterr().out
    if guide == "auto_normal":
        assert whole.rows[-1]["validation_loss"] < whole.rows[0]["validation_loss"]
    half = run(folder, f"{guide}-half", *options)
    again = shutil.copytree(half.folder, folder / f"{guide}-again")
    resumed = run(folder, again.name, *options, "trainer.steps=8")
    for name, value in whole.guide.state_dict().items():
        assert torch.equal(value, resumed.guide.state_dict()[name]), name
    # The classes that the checkpoint names are known, and check says why it cannot use them.
    path = whole.folder / "checkpoint.safetensors"
    with pytest.raises(UserError, match="parameters for windows of its training alone: .* cascaded, flow, joint"):
        assert load(path).guide


MIRROR = torch.tensor([1.0, -1.0, 1.0])


def window_of(clouds: torch.Tensor, geometry: Outline) -> Window:
    """Windows `[B]` of one push, from clouds `[B, 2, M, P, 3]` in the robot's frame."""
    centers = clouds.mean(-2)
    counts = torch.ones(len(clouds), 2, 3, dtype=torch.bool)
    states = State(centers, geometry(clouds - centers.unsqueeze(-2)), counts)
    actions = 2 * torch.rand(len(clouds), 1, 4, generator=torch.Generator().manual_seed(3)) - 1
    return Window(states, actions, counts[:, :1, 0], counts[:, 0, 0])


def test_a_mirrored_window_is_what_mirrored_clouds_give_and_others_stay() -> None:
    geometry, generator = Outline(), torch.Generator().manual_seed(0)
    clouds = 0.05 * torch.randn(4, 2, 3, 64, 3, generator=generator) + torch.rand(4, 1, 3, 1, 3, generator=generator)
    which = torch.tensor([True, False, True, False])
    recorded = window_of(clouds, geometry)
    found = reflect(recorded, which, geometry.mirror_signs(), SPACE)
    expected = window_of(torch.where(which[:, None, None, None, None], clouds * MIRROR, clouds), geometry)
    torch.testing.assert_close(found.states.centers, expected.states.centers)
    torch.testing.assert_close(found.states.features, expected.states.features, atol=1e-5, rtol=0)
    assert not torch.allclose(found.states.features[0], recorded.states.features[0], atol=1e-2)
    for one, other in zip(endpoints(found.actions, REACH), endpoints(recorded.actions, REACH), strict=True):
        torch.testing.assert_close(one, torch.where(which[:, None, None], other * MIRROR[:2], other))
    assert PointNet().mirror_signs() is None


def test_the_world_is_symmetric_about_that_plane() -> None:
    assert (REACH_LOW[1], TABLE_LOW[1]) == (-REACH_HIGH[1], -TABLE_HIGH[1])
    assert (Camera().position[1], Camera().rotation) == (0.0, (0.0, 0.0, 0.0))


def windows_by_hand(seed: int = 0) -> WindowTable:
    generator = torch.Generator().manual_seed(seed)
    centers, features = torch.rand(20, 4, 2, 3, generator=generator), torch.randn(20, 4, 2, 64, generator=generator)
    actions = 2 * torch.rand(20, 3, 4, generator=generator) - 1
    features /= features.norm(dim=-1, keepdim=True)
    return WindowTable.from_episodes(SPACE, centers=centers, features=features, actions=actions, negative_fraction=1.0)


def test_programs_fitted_in_python_have_the_best_weights_and_resume_as_a_checkpoint(tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = CascadedModel(space=SPACE, width=8)
    guide = CascadedGuide(model, width=8)
    options = {"steps": 12, "validate_every": 2, "batch_size": 4, "learning_rate": 0.1, "output": tmp_path / "mine"}
    whole = fit(model, guide, windows_by_hand(), geometry=Outline(), **options)
    assert whole.best_step < 12  # so large a learning rate makes it worse again
    trained = load(tmp_path / "mine" / "checkpoint.safetensors")
    assert trained.provenance["step"] == whole.best_step
    for part, saved in ((model, trained.model), (guide, trained.guide)):
        assert all(torch.equal(value, saved.state_dict()[name]) for name, value in part.state_dict().items())
    best = model.dynamics.change.head.weight.clone()
    nn.init.zeros_(model.dynamics.change.head.weight)
    assert fit(model, guide, windows_by_hand(), geometry=Outline(), **options).rows == whole.rows
    assert torch.equal(model.dynamics.change.head.weight, best)
    with pytest.raises(UserError, match=r"holds a run with seed=0, not 1: "):
        fit(model, guide, windows_by_hand(), geometry=Outline(), seed=1, **options)
    with pytest.raises(UserError, match=r"holds a run with other data"):
        fit(model, guide, windows_by_hand(1), geometry=Outline(), **options)
    with pytest.raises(UserError, match=r"^fit has no option 'patients': choose from steps, .*, patience$"):
        fit(model, guide, windows_by_hand(), patients=2)
    windows = windows_by_hand()
    windows.geometry = "of another"
    with pytest.raises(UserError, match=r"features are not of this Outline"):
        fit(model, guide, windows, geometry=Outline())


def test_an_automatic_guide_is_fitted_in_python_and_writes_nothing(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    with pyro.settings.context(module_local_params=False):  # as by default in Pyro
        model = FlatModel(space=SPACE, width=8)
        run = fit(model, AutomaticGuide(model, autoguide=AutoNormal), windows_by_hand(), steps=2, batch_size=4)
    assert run.best_step == 2 and not list(tmp_path.iterdir()) and not pyro.get_param_store().keys()
