from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import build_model
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.likelihoods import PredictedScales
from cavin_pyro.models.networks.contact.dynamics import ContactDynamics
from cavin_pyro.models.networks.outline import Outline
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.models.priors.conditional import ConditionalPrior
from cavin_pyro.models.priors.mixture import ObjectMixturePrior
from cavin_pyro.storage.checkpoint import load, save


def test_weights_configuration_and_provenance_survive_a_round_trip(small: SimpleNamespace, tmp_path: Path) -> None:
    parts, path = small.parts(), tmp_path / "a.safetensors"
    save(path, **parts, config=small.config(), provenance={"step": 7, "date": "today"})
    checkpoint = load(path)
    assert checkpoint.config == small.config()
    assert checkpoint.provenance == {"step": 7, "date": "today"}
    assert list(tmp_path.iterdir()) == [path]
    others = small.parts(seed=1)
    for name, part in others.items():
        before = part.state_dict()
        assert any(not torch.equal(before[key], value) for key, value in parts[name].state_dict().items())
        checkpoint.load_into(name, part)
        for key, value in parts[name].state_dict().items():
            assert torch.equal(part.state_dict()[key], value)


def test_a_checkpoint_alone_is_enough_to_build_its_parts(small: SimpleNamespace, checkpoint_file: Path) -> None:
    checkpoint = load(checkpoint_file)
    assert checkpoint.guide.model is checkpoint.model
    for name, part in small.parts().items():
        found, expected = getattr(checkpoint, name), part.state_dict()
        assert found.state_dict().keys() == expected.keys()
        assert all(torch.equal(value, expected[key]) for key, value in found.state_dict().items())
        assert not found.training and not any(parameter.requires_grad for parameter in found.parameters())


def test_a_model_built_in_python_needs_no_configuration(tmp_path: Path) -> None:
    path, sizes = tmp_path / "mine.safetensors", {"space": SPACE, "dimension": 4, "width": 8}
    model = CascadedModel(
        space=SPACE,
        effect_dimension=4,
        motion_dimension=4,
        width=8,
        effect_prior=ObjectMixturePrior(**sizes, components=2),
        motion_prior=ConditionalPrior(**sizes, effect_dimension=4),
        scales=PredictedScales(SPACE, height_ratio=0.4),
        dynamics=ContactDynamics(object_width=8, pair_width=8, shape_width=8),
    )
    guide = CascadedGuide(model, width=8, motion_reads_effect=False)
    save(path, model=model, guide=guide, geometry=Outline())
    again = load(path)
    assert type(again.model.prior_of_effects) is ObjectMixturePrior and again.model.scales == model.scales
    for part, found in ((model, again.model), (guide, again.guide)):
        assert all(torch.equal(value, found.state_dict()[name]) for name, value in part.state_dict().items())
    assert type(again.geometry) is Outline and again.provenance["program"].startswith("cavin_pyro")


def test_what_a_checkpoint_cannot_describe_is_refused_with_its_place(small: SimpleNamespace, tmp_path: Path) -> None:
    class Own(CascadedModel):
        """No other program can import it."""

    for model, said in (
        (CascadedModel(space=SPACE, effect_prior=nn.Identity()), r"^model\.effect_prior is a Identity, .*Part"),
        (Own(space=SPACE), "^model is of class .*Own, which no other program can import: move it into a module"),
    ):
        with pytest.raises(UserError, match=said):
            save(tmp_path / "a.safetensors", model=model)
    model, guide = CascadedModel(space=SPACE), CascadedGuide(CascadedModel(space=SPACE))
    wider, spoilt = small.config() | {"model": small.config()["model"] | {"width": 16}}, nn.Linear(1, 1)
    nn.init.constant_(spoilt.weight, float("nan"))
    for parts, said in (
        ({"model": model, "guide": guide}, "^the guide was built for another model"),
        ({"guide": guide}, "^save needs the model of this guide: give model="),
        ({"config": {"model": {}}}, "^save needs a part: give model="),
        ({**small.parts(), "config": wider}, "^config does not describe the parts to save: .*of another architecture"),
        ({**small.parts(), "config": {"model": {}}}, "^config does not describe the parts to save: .*holds no model"),
        ({**small.parts(), "pointnet": PointNet()}, "^two of the parts to save have weights of the same name"),
        ({"net": nn.Linear(1, 1), "config": {"own": {1j}}}, "must be plain data: TypeError: Object of type set"),
        ({"net": spoilt}, r"^these parts cannot be saved: net\.weight holds values that are not finite"),
    ):
        with pytest.raises(UserError, match=said):
            save(tmp_path / "a.safetensors", **parts)
    assert not list(tmp_path.iterdir())


def test_weights_of_another_architecture_are_named(small: SimpleNamespace, checkpoint_file: Path) -> None:
    checkpoint, config = load(checkpoint_file), small.config()
    config["model"]["width"] = 16
    with pytest.raises(UserError, match=r"model\.\S+ has shape \[.*\] in the file and \[.*\] in CascadedModel"):
        checkpoint.load_into("model", build_model(config))
    with pytest.raises(UserError, match="in the file and None in PointNet"):
        checkpoint.load_into("model", PointNet())
    with pytest.raises(UserError, match="has shape None in the file"):
        checkpoint.load_into("decoder", PointNet())
