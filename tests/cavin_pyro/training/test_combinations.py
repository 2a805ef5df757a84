"""Every model with every guide, prior, objective and kind of scales: what fits learns, what does not says so."""

from __future__ import annotations

import copy
import functools
import itertools
import math
import shutil
from pathlib import Path
from typing import Any

import pyro
import pytest
import torch
from omegaconf import DictConfig, OmegaConf
from pyro.infer import Trace_ELBO

from cavin_pyro.config import parts as building
from cavin_pyro.config.commands import TrainerConfig, WindowConfig
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.windows import WindowTable, load_windows
from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.models.state import Window
from cavin_pyro.training.compatibility import check_compatibility
from cavin_pyro.training.elbo import elbo_terms
from cavin_pyro.training.run import build_objective
from cavin_pyro.training.trainer import Trainer

CONF = Path(building.__file__).parent / "presets"
MODELS, GUIDES, PRIORS, OBJECTIVES = (
    sorted(path.stem for path in (CONF / group).glob("*.yaml")) for group in ("model", "guide", "prior", "objective")
)
# Automatic guides learn one batch alone: tests/guides/test_automatic_guides.py.
AUTOMATIC = [name for name in GUIDES if name.startswith("auto_")]
GUIDES = [name for name in GUIDES if name not in AUTOMATIC]
FITTING = {
    "cascaded": {"cascaded", "mean_field", "joint", "flow"},
    "single_latent": {"single_latent"},
    "flat": {"flat"},
    "dynamics": {"none"},
}
CODES = {"cascaded": (16, 16), "single_latent": (32, None), "flat": (None, 32), "dynamics": (None, None)}
DYNAMICS = {"nll_next_centers", "nll_next_features"}
SUBGOAL = {"nll_subgoal_centers", "nll_subgoal_features"}
TERMS = {
    "cascaded": {"kl_effect_code", "kl_motion_code", "nll_actions"} | SUBGOAL | DYNAMICS,
    "single_latent": {"kl_effect_code", "nll_actions"} | SUBGOAL | DYNAMICS,
    "flat": {"kl_motion_code", "nll_actions"} | DYNAMICS,
    "dynamics": DYNAMICS,
}
WITHOUT_CODES = [("dynamics", "none", "standard", name) for name in ("trace_elbo", "mean_field_elbo", "rollout")]
ALL = list(itertools.product(MODELS, GUIDES, PRIORS, OBJECTIVES))
VALID = [names for names in ALL if names in WITHOUT_CODES or (names[0] != "dynamics" and names[1] in FITTING[names[0]])]
# Each guide with each prior, and with them each objective in turn; `make soak` trains all combinations.
PAIRS = {(names[1], names[2]): [other for other in VALID if other[1:3] == names[1:3]] for names in VALID}
OFTEN = {fitting[number % len(fitting)] for number, fitting in enumerate(PAIRS.values())}
STEPS = TrainerConfig(steps=8, batch_size=8, learning_rate=1e-2, validate_every=8, validation_windows=16)


@functools.cache
def section(group: str, choice: str) -> DictConfig:
    """A section of train's configuration with one of its presets: a composition costs more than building its parts."""
    overrides = [f"{group}={choice}", "model.width=8"]
    overrides += ["guide.width=8"] if (group, choice) != ("guide", "none") and choice not in AUTOMATIC else []
    overrides += ["objective.elbo.num_particles=2"] if choice in ("iwae", "renyi") else []
    return compose("train", *overrides, "output=unused")[group]


def composed(
    model: str, guide: str, prior: str = "standard", objective: str = "trace_elbo", scales: str = "fixed"
) -> DictConfig:
    choices = {"model": model, "guide": guide, "prior": prior, "objective": objective, "scales": scales}
    return OmegaConf.create({group: copy.deepcopy(section(group, choice)) for group, choice in choices.items()})


@pytest.fixture(scope="module")
def windows(pushes: Path, tmp_path_factory: pytest.TempPathFactory) -> WindowTable:
    torch.manual_seed(0)
    own = shutil.copytree(pushes, tmp_path_factory.mktemp("combinations") / "pushes")  # features go there
    config = WindowConfig(validation_fraction=0.4, minimum_move=0.001, negative_fraction=1.0)
    return load_windows([own], PointNet().requires_grad_(False).eval(), config, seed=1)


@pytest.fixture
def few(windows: WindowTable) -> Window:
    return windows.batch(windows.training[:3])


def learns(config: DictConfig, table: WindowTable, folder: Path) -> bool:
    """Whether the loss of held-out windows falls in some steps."""

    def validation_loss() -> float:
        torch.manual_seed(3)
        with torch.no_grad():
            terms = elbo_terms(model, guide, table.batch(table.validation))
        return sum(value.item() for value in terms.values())

    torch.manual_seed(0)
    with pyro.settings.context(validate_distributions_pyro=False, validate_distributions_torch=False):
        model = building.build_model(config)
        guide = building.build_guide(config, model)
        objective = build_objective(config, model)
        before = validation_loss()
        Trainer(model, guide, objective, table, folder, lambda step, row: None, STEPS).run()
        after = validation_loss()
    return math.isfinite(after) and after < before - 1


def test_every_preset_is_covered() -> None:
    assert set(MODELS) == set(FITTING)
    assert set(GUIDES) == set().union(*FITTING.values())
    assert {names[1:3] for names in OFTEN} == {names[1:3] for names in VALID}
    assert {names[3] for names in OFTEN} == set(OBJECTIVES)


@pytest.mark.parametrize(
    "names",
    [pytest.param(names, id="-".join(names), marks=() if names in OFTEN else pytest.mark.soak) for names in VALID],
)
def test_compatible_combinations_learn(names: tuple[str, str, str, str], windows: WindowTable, tmp_path: Path) -> None:
    assert learns(composed(*names), windows, tmp_path)


def test_incompatible_combinations_are_refused_in_one_line() -> None:
    invalid = [("cascaded", "flat"), ("flat", "joint"), ("single_latent", "none"), ("dynamics", "cascaded")]
    invalid += [("dynamics", "none", "flow"), ("dynamics", "none", "standard", "iwae"), ("dynamics", "auto_iaf")]
    for names in invalid:
        config = composed(*names)
        with pytest.raises(UserError, match=r"(choose|leave)") as caught:
            program = building.build_model(config)
            building.build_guide(config, program)
            build_objective(config, program)
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="choose guide= from auto_iaf, auto_low_rank, auto_normal, flat$"):
        building.build_guide(composed("flat", "joint"), building.build_model(composed("flat", "joint")))


@pytest.mark.parametrize("name", MODELS)
def test_models_have_the_codes_of_the_paper_and_their_terms(name: str, few: Window) -> None:
    model = building.build_model(compose("train", f"model={name}", "output=unused"))
    assert (model.name, model.effect_dimension if "effect_code" in model.codes else None) == (name, CODES[name][0])
    assert (model.motion_dimension if "motion_code" in model.codes else None) == CODES[name][1]
    for guide in FITTING[name]:
        config = composed(name, guide)
        program = building.build_model(config)
        assert elbo_terms(program, building.build_guide(config, program), few).keys() == TERMS[name]


@pytest.mark.parametrize(
    ("name", "family"),
    [("auto_normal", ""), ("auto_low_rank", ""), ("auto_iaf", ""), ("auto_normal", "AutoStructured")],
)
def test_automatic_guides_are_built_by_option(name: str, family: str) -> None:
    target = f"pyro.infer.autoguide.{family}"
    config = compose("train", f"guide={name}", *([f"guide.autoguide._target_={target}"] if family else []))
    built = building.build_guide(config, building.build_model(config))
    assert type(built.automatic).__name__ == config.guide.autoguide._target_.rpartition(".")[2]
    assert not built.amortized
    if family:
        with pytest.raises(UserError, match=f"choose guide=auto_normal guide.autoguide._target_={target}"):
            building.build_guide({"guide": {"_target_": target}}, building.build_model(config))


class WithMore(CascadedGuide):
    """Samples something that the model does not know."""

    def forward(self, window: Window) -> None:
        super().forward(window)
        pyro.sample("more", pyro.distributions.Normal(0.0, 1.0))


def test_model_and_guide_are_checked_by_their_sites(few: Window) -> None:
    state = torch.get_rng_state()
    for model_name, guides in FITTING.items():
        for guide_name in guides:
            config: Any = composed(model_name, guide_name, "standard" if model_name == "dynamics" else "flow")
            model = building.build_model(config)
            guide = building.build_guide(config, model)
            torch.set_rng_state(state)
            check_compatibility(model, guide, few, Trace_ELBO())
            assert torch.equal(torch.get_rng_state(), state)
    model = building.build_model(composed("cascaded", "cascaded"))
    with pytest.raises(UserError, match="samples effect_code, more, motion_code, but the codes of model Cascaded"):
        check_compatibility(model, WithMore(model, width=8), few, Trace_ELBO())
    model.dynamics.change.maximum_displacement = 1e30
    with pytest.raises(UserError, match="CascadedModel gives next_centers a density that is not finite"):
        check_compatibility(model, building.build_guide(composed("cascaded", "cascaded"), model), few, Trace_ELBO())
