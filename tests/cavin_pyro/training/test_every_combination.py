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

from cavin_pyro.config import parts as building
from cavin_pyro.config.commands.training import TrainerConfig, WindowConfig
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.windows import WindowTable, load_windows
from cavin_pyro.training.elbo import elbo_terms
from cavin_pyro.training.factory import build_objective
from cavin_pyro.training.trainer import Trainer
from models.networks.pointnet import PointNet

CONF = Path(building.__file__).parent / "presets"
MODELS, GUIDES, PRIORS, OBJECTIVES = (
    sorted(path.stem for path in (CONF / group).glob("*.yaml")) for group in ("model", "guide", "prior", "objective")
)
# Automatic guides learn one batch alone: tests/guides/test_automatic_guides.py.
GUIDES = [name for name in GUIDES if not name.startswith("auto_")]
FITTING = {
    "cascaded": {"cascaded", "mean_field", "joint", "flow"},
    "single_latent": {"single_latent"},
    "flat": {"flat"},
    "dynamics": {"none"},
}
FITTING_MOTIONS = {"consistent", "hindsight"}  # objectives
COMBINATIONS_WITHOUT_CODES = {
    ("dynamics", "none", "standard", objective)
    for objective in ("trace_elbo", "mean_field_elbo", "trace_graph_elbo", "trace_enum_elbo", "rollout")
}
ALL = list(itertools.product(MODELS, GUIDES, PRIORS, OBJECTIVES))


def is_valid(names: tuple[str, str, str, str]) -> bool:
    model, guide, prior, objective = names
    if model == "dynamics":
        return names in COMBINATIONS_WITHOUT_CODES
    motions_have_a_prior_to_fit = model == "cascaded" and prior != "standard"
    return guide in FITTING[model] and (objective not in FITTING_MOTIONS or motions_have_a_prior_to_fit)


VALID = [names for names in ALL if is_valid(names)]
# Representatives are combinations in which every two choices meet that could disagree with one another: each guide with
# each prior, and each objective with each guide in turn. `make test` trains most of them, `make soak` all combinations.
TURNS = {(names[1], names[2]): [] for names in VALID}
for names in VALID:
    TURNS[names[1], names[2]].append(names)
REPRESENTATIVES = {names for names in VALID if names[0] == "dynamics"} | {
    fitting[(GUIDES.index(guide) + PRIORS.index(prior)) % len(fitting)] for (guide, prior), fitting in TURNS.items()
}
OFTEN = {names for names in REPRESENTATIVES if names[3] not in FITTING_MOTIONS}  # which have tests of their own
STEPS = TrainerConfig(steps=40, batch_size=16, learning_rate=1e-2, validate_every=40, validation_windows=64)


@functools.cache
def section(group: str, choice: str) -> DictConfig:
    """A section of train's configuration with one of its presets: a composition costs more than building its parts."""
    overrides = [
        f"{group}={choice}",
        "model.width=8",
        *(["guide.width=8"] if (group, choice) != ("guide", "none") else []),
    ]
    overrides += ["objective.elbo.num_particles=2"] if choice in ("iwae", "renyi") else []
    return compose("train", *overrides, "output=unused")[group]


def composed(model: str, guide: str, prior: str, objective: str, scales: str = "fixed") -> DictConfig:
    choices = {"model": model, "guide": guide, "prior": prior, "objective": objective, "scales": scales}
    return OmegaConf.create({group: copy.deepcopy(section(group, choice)) for group, choice in choices.items()})


@pytest.fixture(scope="module")
def windows(pushes: Path, tmp_path_factory: pytest.TempPathFactory) -> WindowTable:
    torch.manual_seed(0)
    own = shutil.copytree(pushes, tmp_path_factory.mktemp("combinations") / "pushes")  # features go there
    config = WindowConfig(validation_fraction=0.4, minimum_move=0.001, negative_fraction=1.0)
    return load_windows([own], PointNet().requires_grad_(False).eval(), config, seed=1)


def validation_loss(model: Any, guide: Any, table: WindowTable) -> float:
    torch.manual_seed(3)
    with torch.no_grad():
        return sum(value.item() for value in elbo_terms(model, guide, table.batch(table.validation)).values())


def losses(config: DictConfig, table: WindowTable, folder: Path) -> tuple[float, float]:
    """On held-out windows, before and after 40 steps."""
    torch.manual_seed(0)
    with pyro.settings.context(
        module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False
    ):
        model = building.build_model(config)
        guide = building.build_guide(config, model)
        objective = build_objective(config, model)
        before = validation_loss(model, guide, table)
        Trainer(model, guide, objective, table, folder, lambda step, row: None, STEPS).run()
        return before, validation_loss(model, guide, table)


def test_every_preset_is_covered() -> None:
    assert set(MODELS) == set(FITTING)
    assert set(GUIDES) == set().union(*FITTING.values())
    assert {"standard", "conditional", "flow", "mixture"} <= set(PRIORS)
    assert {"trace_elbo", "mean_field_elbo", "trace_graph_elbo", "trace_enum_elbo"} <= set(OBJECTIVES)
    assert {"iwae", "renyi", "counterfactual", "rollout", "consistent"} <= set(OBJECTIVES)


def test_the_representatives_cover_every_guide_with_every_prior_and_every_objective() -> None:
    pairs = {names[1:3] for names in VALID}
    assert {names[1:3] for names in REPRESENTATIVES} == pairs
    assert {names[3] for names in REPRESENTATIVES} == set(OBJECTIVES)


def test_the_sections_are_those_of_one_composition() -> None:
    names = ("flat", "flat", "flow", "mean_field_elbo", "learned")
    choices = dict(zip(("model", "guide", "prior", "objective", "scales"), names, strict=True))
    overrides = [f"{group}={choice}" for group, choice in choices.items()]
    config = compose("train", *overrides, "model.width=8", "guide.width=8")
    assert composed(*names) == {group: config[group] for group in choices}


@pytest.mark.soak
def test_sections_of_their_own_are_those_of_one_composition_for_one_combination_of_each_kind() -> None:
    some = {names[:2]: names for names in VALID}.values()  # the last of each model with each guide
    assert len(some) >= 7
    for names in some:
        choices = dict(zip(("model", "guide", "prior", "objective"), names, strict=True))
        overrides = [f"{group}={choice}" for group, choice in choices.items()] + ["model.width=8"]
        overrides += [] if names[1] == "none" else ["guide.width=8"]
        overrides += ["objective.elbo.num_particles=2"] if names[3] in ("iwae", "renyi") else []
        config = compose("train", *overrides)
        assert composed(*names) == {group: config[group] for group in [*choices, "scales"]}


@pytest.mark.parametrize(
    "names",
    [pytest.param(names, id="-".join(names), marks=() if names in OFTEN else pytest.mark.soak) for names in VALID],
)
def test_compatible_combinations_learn(names: tuple[str, str, str, str], windows: WindowTable, tmp_path: Path) -> None:
    before, after = losses(composed(*names), windows, tmp_path)
    assert math.isfinite(after) and after < before - 1


@pytest.mark.parametrize(
    "model", [model if model == "cascaded" else pytest.param(model, marks=pytest.mark.soak) for model in MODELS]
)
def test_incompatible_combinations_are_refused_in_one_line(model: str) -> None:
    for names in ALL:
        if names[0] == model and names not in VALID:
            config = composed(*names)
            with pytest.raises(UserError, match=r"(choose|leave)") as caught:
                program = building.build_model(config)
                building.build_guide(config, program)
                build_objective(config, program)
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize("model", MODELS)
def test_learned_scales_learn_with_every_model(model: str, windows: WindowTable, tmp_path: Path) -> None:
    guide = sorted(FITTING[model])[0]
    before, after = losses(composed(model, guide, "standard", "trace_elbo", "learned"), windows, tmp_path)
    assert math.isfinite(after) and after < before - 1


@pytest.mark.parametrize("option", ["objective.warm_up_steps=30", "objective.kl_weights.effect_code=0.5"])
def test_weighted_kl_terms_learn(option: str, windows: WindowTable, tmp_path: Path) -> None:
    config = composed("cascaded", "cascaded", "standard", "trace_elbo")
    section, _, value = option.rpartition("=")
    config_section: Any = config.objective
    *path, last = section.split(".")[1:]
    for name in path:
        config_section = config_section[name]
    config_section[last] = type(config_section[last])(value)
    before, after = losses(config, windows, tmp_path)
    assert math.isfinite(after) and after < before - 1
