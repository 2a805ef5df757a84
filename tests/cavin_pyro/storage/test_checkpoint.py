from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import build_guide, build_model
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.storage.checkpoint import load_checkpoint, save_checkpoint
from cavin_pyro.storage.geometry import load_pointnet


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


@pytest.mark.parametrize("length", [0, 7, 5000, -1])
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
