"""From the trainings of a reproduction to shipped checkpoints and the facts of their model cards."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors.torch import save

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import build_model
from cavin_pyro.storage import shipping
from cavin_pyro.storage.checkpoint import checkpoint_bytes, load_checkpoint, save_checkpoint
from cavin_pyro.storage.digests import read_manifest
from cavin_pyro.storage.files import file_digest
from cavin_pyro.storage.shipping import main, ship, ship_calibrated, ship_models

LOSSES = {0: -3.0, 1: -7.5, 2: -5.0}  # by training seed


@pytest.fixture
def home(tmp_path: Path, small: SimpleNamespace) -> Path:
    """A reproduction whose trainings of SeCTAR have ended."""
    home = tmp_path / "run"
    for seed, loss in LOSSES.items():
        folder = home / "train" / f"sectar-{seed}"
        folder.mkdir(parents=True)
        torch.manual_seed(seed)
        path = folder / "checkpoint.safetensors"
        small.save_baseline(path, "single_latent", seed=seed, output=str(folder), data=f"{home}/data")
        content = load_checkpoint(path)
        provenance = {
            "step": 10 + seed,
            "metrics": {"validation_loss": loss},
            "data": [{"transitions": 60, "episodes": 12}],
            "training_windows": 40,
            "validation_windows": 4,
            "command": f"python -m cavin_pyro.train data={home}/data seed={seed} output={folder}",
            "revision": "12ab",
            "pointnet": {"command": f"python -m cavin_pyro.pretrain output={tmp_path}/another/pretrain"},
        }
        header = {"format": "cavin_pyro checkpoint", "version": "1"}
        header |= {"config": json.dumps(content.config), "provenance": json.dumps(provenance)}
        path.write_bytes(save(content.tensors, metadata=header))
        (folder / "metrics.json").write_text(json.dumps({"steps": 20}))
    return home


def test_the_training_with_the_lowest_validation_loss_is_shipped_with_its_facts(home: Path, tmp_path: Path) -> None:
    found = ship(home, "sectar", tmp_path / "shipped")
    assert json.loads((tmp_path / "shipped" / "sectar.json").read_text()) == found
    parameters = found.pop("parameters")
    assert found == {
        "training_seed": 1,
        "steps": 20,
        "best_step": 11,
        "validation_loss": -7.5,
        "transitions": 60,
        "episodes": 12,
        "training_windows": 40,
        "validation_windows": 4,
        "command": "python -m cavin_pyro.train data=runs/reproduce/data seed=1 output=runs/reproduce/train/sectar-1",
        "revision": "12ab",
        "validation_losses": {"0": -3.0, "1": -7.5, "2": -5.0},
    }
    shipped = load_checkpoint(tmp_path / "shipped" / "sectar.safetensors")
    model = build_model(shipped.config)
    assert parameters["model"] == sum(one.numel() for one in model.state_dict().values()) > 0
    assert set(parameters) == {"model", "guide", "pointnet"}


def test_a_shipped_file_has_the_weights_as_they_were_and_no_path_of_the_machine(home: Path, tmp_path: Path) -> None:
    ship(home, "sectar", tmp_path / "shipped")
    path = tmp_path / "shipped" / "sectar.safetensors"
    before, after = (load_checkpoint(one) for one in (home / "train/sectar-1/checkpoint.safetensors", path))
    assert before.tensors.keys() == after.tensors.keys()
    assert all(torch.equal(before.tensors[name], after.tensors[name]) for name in after.tensors)
    assert str(tmp_path).encode() not in path.read_bytes()
    assert after.config == {**before.config, "output": "runs/reproduce/train/sectar-1", "data": "runs/reproduce/data"}


@pytest.mark.parametrize("name", ["józef", "two words", 'quoted" \\ back', "o'brien"])
def test_no_path_of_the_machine_is_shipped_whatever_the_folder_is_called(name: str, home: Path, tmp_path: Path) -> None:
    """Commands have their arguments quoted for a shell, and JSON escapes letters, quotes and backslashes."""
    moved, pretrained = tmp_path / name / "run", tmp_path / name / "another" / "pretrain"
    moved.parent.mkdir()
    home.rename(moved)
    path = moved / "train" / "sectar-1" / "checkpoint.safetensors"
    content = load_checkpoint(path)
    config = {**content.config, "output": str(path.parent), "data": [f"{moved}/data"]}
    arguments = [shlex.quote(f"{option}={moved}/{end}") for option, end in (("data", "data"), ("output", "train/x"))]
    provenance = {
        **content.provenance,
        "command": " ".join(["python -m cavin_pyro.train", *arguments]),
        "pointnet": {"command": f"python -m cavin_pyro.pretrain {shlex.quote(f'output={pretrained}')} seed=1"},
    }
    path.write_bytes(checkpoint_bytes(content.tensors, config, provenance))
    ship(moved, "sectar", tmp_path / "shipped")
    after = load_checkpoint(tmp_path / "shipped" / "sectar.safetensors")
    assert (after.config["output"], after.config["data"]) == ("runs/reproduce/train/sectar-1", ["runs/reproduce/data"])
    found = [shlex.split(one["command"])[3:] for one in (after.provenance, after.provenance["pointnet"])]
    assert found == [
        ["data=runs/reproduce/data", "output=runs/reproduce/train/x"],
        ["output=runs/reproduce/pretrain", "seed=1"],
    ]
    assert str(tmp_path) not in str((after.config, after.provenance))


def test_what_is_missing_or_unfinished_is_not_shipped(home: Path, tmp_path: Path) -> None:
    shipped = tmp_path / "shipped"
    with pytest.raises(UserError, match="holds no training of mpc"):
        ship(home, "mpc", shipped)
    with pytest.raises(UserError, match="^unknown method 'best': choose from cavin, .*sectar, cvae_mpc, mpc$"):
        ship(home, "best", shipped)
    (home / "train" / "sectar-2" / "metrics.json").unlink()
    with pytest.raises(UserError, match="sectar-2 has not finished"):
        ship(home, "sectar", shipped)
    assert not shipped.exists()


def test_the_command_ships_the_methods_that_it_is_given(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shipping, "shipped_folder", lambda: tmp_path / "shipped")
    monkeypatch.setattr(sys, "argv", ["shipping", str(home), "sectar"])
    main()
    assert capsys.readouterr().out.startswith("sectar: training seed 1, best step 11 of 20, validation losses by seed")
    monkeypatch.setattr(sys, "argv", ["shipping", str(home)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("error: ") and (tmp_path / "shipped" / "sectar.safetensors").exists()


def test_all_trainings_are_shipped_by_method_and_seed(home: Path, tmp_path: Path) -> None:
    shipped = ship_models(home, tmp_path / "models")
    assert [path.name for path in shipped] == [f"sectar-{seed}.safetensors" for seed in LOSSES]
    for path in shipped:
        trained = load_checkpoint(home / "train" / path.stem / "checkpoint.safetensors")
        assert all(torch.equal(value, trained.tensors[name]) for name, value in load_checkpoint(path).tensors.items())
        assert str(home).encode() not in path.read_bytes()
    (home / "train" / "sectar-1" / "metrics.json").unlink()
    with pytest.raises(UserError, match="sectar-1 has not finished: rerun reproduce to resume it"):
        ship_models(home, tmp_path / "models")


def calibrate_by_hand(small: SimpleNamespace, shipped: Path, to: Path, *, part: str, **config: Any) -> None:
    """What `calibrate` would write for a shipped file, but for numbers of one part, which grow by 1."""
    content = load_checkpoint(shipped)
    modules = small.parts()
    for name, module in modules.items():
        content.load_into(name, module, shipped)
    with torch.no_grad():
        for parameter in modules[part].parameters():
            parameter.add_(1.0)
    about = {**content.provenance, "calibrated": [{"steps": 3, "checkpoint": file_digest(shipped)}]}
    save_checkpoint(to, parts=modules, config={**content.config, **config}, provenance=about)


@pytest.fixture
def shipped(small: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of shipped checkpoints with `cavin`."""
    folder = tmp_path / "shipped"
    path = folder / "cavin.safetensors"
    folder.mkdir()
    save_checkpoint(path, parts=small.parts(), config={**small.config(), "output": "runs/long"}, provenance={"step": 7})
    monkeypatch.setattr(shipping, "shipped_folder", lambda: folder)
    return path


def test_a_calibrated_guide_is_shipped_with_the_model_as_it_was(
    small: SimpleNamespace, shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, calibrated = load_checkpoint(shipped), tmp_path / "calibrated.safetensors"
    calibrate_by_hand(small, shipped, calibrated, part="guide")
    monkeypatch.setattr(sys, "argv", ["shipping", "--calibrated", str(calibrated), "cavin"])
    main()
    after = load_checkpoint(shipped)
    changed = {name for name, value in before.tensors.items() if not torch.equal(value, after.tensors[name])}
    assert changed and all(name.startswith("guide.") for name in changed)
    assert after.provenance["step"] == 7 and after.provenance["calibrated"][-1]["steps"] == 3
    assert read_manifest(shipped.parent) == {"cavin.safetensors": file_digest(shipped)}


def test_a_guide_with_another_model_or_of_another_file_is_not_shipped(
    small: SimpleNamespace, shipped: Path, tmp_path: Path
) -> None:
    digest, calibrated = file_digest(shipped), tmp_path / "calibrated.safetensors"
    calibrate_by_hand(small, shipped, calibrated, part="model")
    with pytest.raises(UserError, match=r"differs from .* in model\..*, which was not calibrated"):
        ship_calibrated(calibrated, shipped)
    calibrate_by_hand(small, shipped, calibrated, part="guide", seed=5)
    with pytest.raises(UserError, match="has another configuration"):
        ship_calibrated(calibrated, shipped)
    assert file_digest(shipped) == digest
    calibrate_by_hand(small, shipped, calibrated, part="guide")
    ship_calibrated(calibrated, shipped)
    with pytest.raises(UserError, match="is no calibration of"):  # of the file as it was before
        ship_calibrated(calibrated, shipped)


def test_calibrated_scales_are_shipped_and_nothing_else_of_f(
    small: SimpleNamespace, shipped: Path, tmp_path: Path
) -> None:
    """One number of one bias; the fixed scales of `cavin` have none, so it gets one here."""
    name, calibrated = shipping.SCALES, tmp_path / "calibrated.safetensors"
    content = load_checkpoint(shipped)
    tensors = {**{key: value.clone() for key, value in content.tensors.items()}, name: torch.zeros(4)}
    shipped.write_bytes(checkpoint_bytes(tensors, content.config, content.provenance))

    def calibrate(bias: list[float], parts: list[str]) -> None:
        about = {**content.provenance, "calibrated": [{"parts": parts, "checkpoint": file_digest(shipped)}]}
        calibrated.write_bytes(checkpoint_bytes({**tensors, name: torch.tensor(bias)}, content.config, about))

    for bias, parts in (([0.0, 0.0, 0.0, 0.3], ["guide"]), ([0.0, 0.1, 0.0, 0.3], ["scales"])):
        calibrate(bias, parts)
        with pytest.raises(UserError, match=f"differs from .* in {name}, which was not calibrated"):
            ship_calibrated(calibrated, shipped)
    calibrate([0.0, 0.0, 0.0, 0.3], ["scales"])
    ship_calibrated(calibrated, shipped)
    assert load_checkpoint(shipped).tensors[name].tolist() == pytest.approx([0.0, 0.0, 0.0, 0.3])
