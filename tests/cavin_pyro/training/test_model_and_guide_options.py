"""`model=` and `guide=` on the command line of train: every combination is built or refused."""

from __future__ import annotations

import functools
from importlib import resources

import pytest
import torch
from hydra.utils import get_class
from omegaconf import DictConfig
from pyro.infer import Trace_ELBO
from torch.nn import functional

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import build_guide, build_model
from cavin_pyro.training.elbo import elbo_terms, term_counts
from models.state import State, Window

DYNAMICS = {"nll_next_centers", "nll_next_features"}
SUBGOAL = {"nll_subgoal_centers", "nll_subgoal_features"}
TERMS = {
    "cascaded": {"kl_effect_code", "kl_motion_code", "nll_actions"} | SUBGOAL | DYNAMICS,
    "single_latent": {"kl_effect_code", "nll_actions"} | SUBGOAL | DYNAMICS,
    "flat": {"kl_motion_code", "nll_actions"} | DYNAMICS,
    "dynamics": DYNAMICS,
}
CODES = {"cascaded": (16, 16), "single_latent": (32, None), "flat": (None, 32), "dynamics": (None, None)}


def preset_names(group: str) -> list[str]:
    folder = resources.files("cavin_pyro.config") / "presets" / group
    return sorted(file.name.removesuffix(".yaml") for file in folder.iterdir() if file.name.endswith(".yaml"))


@functools.cache
def configuration(*overrides: str) -> DictConfig:
    """To be read only."""
    return compose("train", *overrides, "output=unused")


def window(batch: int = 6) -> Window:
    """Some windows and transitions do not count."""
    features = functional.normalize(torch.randn(batch, 4, 5, 64), dim=-1)
    states = State(torch.rand(batch, 4, 5, 3), features, torch.ones(batch, 4, 5, dtype=torch.bool))
    transition_mask = torch.arange(3 * batch).reshape(batch, 3) % 4 != 1
    return Window(states, torch.rand(batch, 3, 4), transition_mask, torch.arange(batch) % 3 != 1)


def test_every_model_of_the_paper_has_a_preset() -> None:
    assert preset_names("model") == sorted(TERMS)


@pytest.mark.parametrize("name", TERMS)
def test_codes_have_the_dimensions_of_the_paper(name: str) -> None:
    model = build_model(configuration(f"model={name}"))
    found = tuple(getattr(model, f"{kind}_dimension", None) for kind in ("effect", "motion"))
    assert (model.name, found) == (name, CODES[name])


AUTOMATIC = [name for name in preset_names("guide") if name.startswith("auto_")]


@pytest.mark.parametrize("guide", [name for name in preset_names("guide") if name not in AUTOMATIC])
@pytest.mark.parametrize("name", TERMS)
def test_a_model_and_guide_have_the_terms_of_the_model_or_are_refused(name: str, guide: str) -> None:
    config = configuration(f"model={name}", f"guide={guide}")
    model, fits = build_model(config), get_class(config.guide._target_).fits
    if name not in fits:
        choices = [option for option in preset_names("guide") if name in get_class(guide_class(option)).fits]
        with pytest.raises(UserError) as caught:
            build_guide(config, model)
        assert str(caught.value) == (
            f"guide {config.guide._target_} does not fit model {type(model).__name__} (it fits {', '.join(fits)}): "
            f"choose guide= from {', '.join(choices)}"
        )
        return
    programs, batch = (model, build_guide(config, model)), window()
    torch.manual_seed(0)
    loss = Trace_ELBO()(*programs)(batch)
    torch.manual_seed(0)
    terms = elbo_terms(*programs, batch)
    assert terms.keys() == TERMS[name]
    assert sum(value.item() for value in terms.values()) == pytest.approx(loss.item(), rel=1e-5)
    assert term_counts(terms, batch) == {term: 13 if term in DYNAMICS else 4 for term in terms}


@pytest.mark.parametrize("guide", AUTOMATIC)
def test_automatic_guides_are_built_by_option_and_refused_where_there_are_no_codes(guide: str) -> None:
    config = configuration(f"guide={guide}")
    built = build_guide(config, build_model(config))
    assert type(built.automatic).__name__ == config.guide.autoguide._target_.rpartition(".")[2]
    assert not built.amortized
    with pytest.raises(UserError, match="does not fit model DynamicsModel .* choose guide= from none$"):
        build_guide(config, build_model(configuration("model=dynamics", "guide=none")))


def test_any_automatic_guide_can_be_named_and_one_in_the_wrong_place_says_where() -> None:
    target = "pyro.infer.autoguide.AutoStructured"
    model = build_model(configuration())
    built = build_guide(configuration("guide=auto_normal", f"guide.autoguide._target_={target}"), model)
    assert type(built.automatic).__name__ == "AutoStructured"
    with pytest.raises(UserError, match=f"choose guide=auto_normal guide.autoguide._target_={target}"):
        build_guide(configuration("guide=none", f"guide._target_={target}"), model)


def guide_class(option: str) -> str:
    return configuration(f"guide={option}").guide._target_


@pytest.mark.parametrize("weight", ["0", "-1", "0.0"])
def test_the_balance_of_states_and_actions_is_a_positive_number(weight: str) -> None:
    config = configuration("model=single_latent", f"model.action_weight={weight}")
    with pytest.raises(UserError, match=f"^model.action_weight must be a positive number, not {weight}$"):
        build_model(config)
    assert build_model(configuration("model=single_latent", "model.action_weight=2")).action_weight == 2
