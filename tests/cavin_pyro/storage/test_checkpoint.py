from __future__ import annotations

import copy
import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import build_guide, build_model
from cavin_pyro.storage.checkpoint import default_checkpoint, find_checkpoint, load_checkpoint, save_checkpoint
from cavin_pyro.storage.geometry import load_pointnet
from models.networks.pointnet import PointNet


def rewritten(path: Path, folder: Path, config: dict[str, Any]) -> Path:
    """A copy whose header holds another configuration."""
    header = {
        "format": "cavin_pyro checkpoint",
        "version": "1",
        "config": json.dumps(config),
        "provenance": "{}",
    }
    save_file(load_file(path), folder / "rewritten.safetensors", metadata=header)
    return folder / "rewritten.safetensors"


def test_weights_configuration_and_provenance_survive_a_round_trip(small: SimpleNamespace, tmp_path: Path) -> None:
    parts, path = small.parts(), tmp_path / "a.safetensors"
    save_checkpoint(path, parts=parts, config=small.config(), provenance={"step": 7, "date": "today"})
    checkpoint = load_checkpoint(path)
    assert checkpoint.config == small.config()
    assert checkpoint.provenance == {"step": 7, "date": "today"}
    assert list(tmp_path.iterdir()) == [path]
    others = small.parts(seed=1)
    for name, part in others.items():
        before = part.state_dict()
        assert any(not torch.equal(before[key], value) for key, value in parts[name].state_dict().items())
        checkpoint.load_into(name, part, path)
        for key, value in parts[name].state_dict().items():
            assert torch.equal(part.state_dict()[key], value)


def test_a_checkpoint_alone_is_enough_to_build_its_parts(small: SimpleNamespace, checkpoint_file: Path) -> None:
    checkpoint = load_checkpoint(checkpoint_file)
    model = build_model(checkpoint.config)
    checkpoint.load_into("model", model, checkpoint_file)
    checkpoint.load_into("guide", build_guide(checkpoint.config, model), checkpoint_file)
    expected = small.parts()["model"].state_dict()
    assert model.state_dict().keys() == expected.keys()
    assert all(torch.equal(value, expected[name]) for name, value in model.state_dict().items())
    pointnet = load_pointnet(checkpoint_file)
    assert not pointnet.training
    assert not any(parameter.requires_grad for parameter in pointnet.parameters())


def test_a_write_that_fails_leaves_the_earlier_checkpoint(
    small: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, parts=small.parts(), config={}, provenance={"step": 1})

    def refuse(path: Path, content: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(OSError, match="No space left"):
        save_checkpoint(path, parts=small.parts(), config={}, provenance={"step": 2})
    assert load_checkpoint(path).provenance == {"step": 1}
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("length", [0, 7, 100, 5000, -1])
def test_a_checkpoint_cut_short_is_refused(length: int, checkpoint_file: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.safetensors"
    path.write_bytes(checkpoint_file.read_bytes()[:length])
    with pytest.raises(UserError, match=r"cut\.safetensors is truncated or no safetensors file"):
        load_checkpoint(path)


def test_weights_of_another_architecture_are_named(small: SimpleNamespace, checkpoint_file: Path) -> None:
    checkpoint, config = load_checkpoint(checkpoint_file), small.config()
    config["model"]["width"] = 16
    with pytest.raises(UserError, match=r"model\.\S+ has shape \[.*\] in the file and \[.*\] in CascadedModel"):
        checkpoint.load_into("model", build_model(config), checkpoint_file)
    with pytest.raises(UserError, match="in the file and None in PointNet"):
        checkpoint.load_into("model", PointNet(), checkpoint_file)
    with pytest.raises(UserError, match="has shape None in the file"):
        checkpoint.load_into("decoder", PointNet(), checkpoint_file)


@pytest.mark.parametrize(
    "target",
    [
        "builtins.exec",
        "subprocess.run",
        "models.networks.pointnet.torch.save",  # what our modules import is not ours
        "models.cascaded.nn.Linear",
        "guides.cascaded.pyro.sample",
        "models.cascaded",
        "models.networks.pointnet.chamfer_distance",
        "models.nothing.Nothing",
        "modelsandmore.Trojan",
        "models",
        "",
    ],
)
@pytest.mark.parametrize("section", ["model", "prior", "guide"])
def test_a_checkpoint_may_name_classes_of_this_program_only(
    section: str, target: str, small: SimpleNamespace, checkpoint_file: Path, tmp_path: Path
) -> None:
    for place in ((section,), (section, "scales"), (section, "list", 0)):
        config = copy.deepcopy(small.config())
        config[section]["scales"], config[section]["list"] = {}, [{}]
        part: Any = config
        for step in place:
            part = part[step]
        part["_target_"] = target
        with pytest.raises(UserError, match=r"asks to run .*, which is not part of this program"):
            load_checkpoint(rewritten(checkpoint_file, tmp_path, config))


def test_a_module_that_the_user_trusts_may_be_named(
    small: SimpleNamespace, checkpoint_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = "from models.priors.standard import StandardPrior\n\nclass OwnPrior(StandardPrior):\n    pass\n"
    (tmp_path / "parts_of_mine.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    config = small.config()
    config["prior"]["_target_"] = "parts_of_mine.OwnPrior"
    path = rewritten(checkpoint_file, tmp_path, config)
    with pytest.raises(UserError, match=r"pass 'trust=\[parts_of_mine\]'"):
        load_checkpoint(path)
    assert "parts_of_mine" not in sys.modules  # not even imported
    with pytest.raises(UserError, match=r'^trust must be a list of modules, \["parts_of_mine"\] in Python, not'):
        load_checkpoint(path, trust="parts_of_mine")
    model = build_model(load_checkpoint(path, trust=["parts_of_mine"]).config)
    assert type(model.prior_of_effects).__name__ == "OwnPrior"


def test_sections_that_are_never_built_are_not_checked(
    small: SimpleNamespace, checkpoint_file: Path, tmp_path: Path
) -> None:
    config = {**small.config(), "objective": {"_target_": "pyro.infer.Trace_ELBO"}}
    assert load_checkpoint(rewritten(checkpoint_file, tmp_path, config)).config == config


def test_the_default_checkpoint_lies_in_the_checkout() -> None:
    root = Path(__file__).resolve().parents[3]
    assert default_checkpoint() == root / "checkpoints" / "cavin.safetensors"


@pytest.mark.parametrize("name", ["a" * 300, "a" * 250, f"{'a' * 300}.safetensors", f"folder/{'a' * 300}"])
def test_a_name_that_no_file_can_have_is_one_line(name: str) -> None:
    with pytest.raises(UserError, match=r"(unknown checkpoint 'a+': choose from|no checkpoint at )"):
        load_checkpoint(find_checkpoint(name))


def test_a_checkpoint_that_may_not_be_looked_for_is_one_line(
    checkpoint_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path, *arguments: object, **options: object) -> None:
        raise PermissionError(13, os.strerror(13), str(path))

    monkeypatch.setattr(os, "stat", refuse)
    with pytest.raises(UserError, match=r"cannot be read: Permission denied"):
        load_checkpoint(checkpoint_file)
