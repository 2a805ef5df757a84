from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import build_guide, build_model, construct
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.outline import Outline
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.storage.checkpoint import load, save
from cavin_pyro.storage.geometry import check_fit


class AnotherModel(Model):
    """A model that no guide knows."""

    name = "another"


def test_a_model_gets_a_prior_of_its_own_size_for_each_code(small: SimpleNamespace) -> None:
    config = small.config()
    config["model"] |= {"effect_dimension": 4, "motion_dimension": 6}
    model = build_model(config)
    assert model.prior_of_effects.dimension == 4
    assert model.prior_of_motions.dimension == 6
    assert model.width == 8


@pytest.mark.parametrize("prior", ["standard", "conditional", "flow", "mixture"])
@pytest.mark.parametrize("guide", ["cascaded", "flow"])
def test_presets_of_priors_and_guides_build_what_a_checkpoint_builds_again(
    prior: str, guide: str, tmp_path: Path
) -> None:
    overrides = [f"prior={prior}", f"guide={guide}", "model.width=8", "guide.width=8"]
    config = OmegaConf.to_container(compose("train", *overrides))
    model = build_model(config)
    parts = {"model": model, "guide": build_guide(config, model)}
    save(tmp_path / "a.safetensors", **parts, config=config, provenance={})
    checkpoint = load(tmp_path / "a.safetensors")
    again = build_model(checkpoint.config)
    for part, module in {"model": again, "guide": build_guide(checkpoint.config, again)}.items():
        checkpoint.load_into(part, module)
        weights = parts[part].state_dict()
        assert all(torch.equal(value, weights[name]) for name, value in module.state_dict().items())


def test_a_guide_that_does_not_fit_its_model_is_refused_by_name(small: SimpleNamespace) -> None:
    with pytest.raises(UserError) as caught:
        build_guide(small.config(), AnotherModel(space=SPACE))
    assert str(caught.value) == (
        "guide cavin_pyro.guides.cascaded.CascadedGuide does not fit model AnotherModel (it fits cascaded): "
        "choose guide= from none of ours"
    )


@pytest.mark.parametrize(
    ("part", "said"),
    [({"_target_": "my_lab.Nothing"}, "my_lab.Nothing cannot be built"), ({"depth": 3}, "a part has no _target_")],
)
def test_parts_that_cannot_be_built_are_named(part: dict, said: str) -> None:
    with pytest.raises(UserError, match=said) as caught:
        construct(part)
    assert "\n" not in str(caught.value)


FLOW, SCALES = "cavin_pyro.models.priors.flow.FlowPrior", "cavin_pyro.models.likelihoods.PredictedScales"
CONTACT = "cavin_pyro.models.networks.contact.dynamics.ContactDynamics"


@pytest.mark.parametrize(
    ("section", "options", "said"),
    [
        ("prior", {"_target_": FLOW, "width": 0}, "^prior.width must be at least 1, not 0$"),
        ("prior", {"_target_": FLOW, "depth": 3}, f"{FLOW} cannot be built: .*'depth'"),
        ("prior", {"_target_": "torch.nn.Identity"}, "^effect_prior must give, .*, not an object of State"),
        ("dynamics", {"_target_": "builtins.int"}, "^builtins.int is no Outcome: derive it from cavin_pyro.models"),
        ("scales", {"_target_": SCALES}, "scales=predicted needs an f that predicts them: dynamics=contact"),
        ("dynamics", {"_target_": CONTACT, "reach_margin": -0.01}, "^reach_margin must be null .*, not -0.01$"),
    ],
)
def test_options_that_a_part_of_a_model_does_not_take_are_named(
    section: str, options: dict, said: str, small: SimpleNamespace
) -> None:
    with pytest.raises(UserError, match=said) as caught:
        build_model(small.config() | {section: options})
    assert "\n" not in str(caught.value)


def test_a_model_must_take_the_features_and_the_objects_that_there_are(small: SimpleNamespace) -> None:
    dynamics, scales = {"_target_": CONTACT, "object_width": 8}, {"_target_": SCALES}
    model, contact = build_model(small.config()), build_model(small.config() | {"dynamics": dynamics, "scales": scales})
    check_fit(model, PointNet(), 5)
    check_fit(contact, Outline(), 5)
    for one, geometry, objects, said in (
        (model, PointNet(32), 5, "feature_dimension=64, but the PointNet's features have 32"),
        (model, PointNet(), 6, "maximum_objects=5, but datasets have room for 6"),
        (contact, PointNet(), 5, "reads the features of Outline, not of PointNet: pass geometry=outline"),
    ):
        with pytest.raises(UserError, match=said):
            check_fit(one, geometry, objects)
