"""Every model with every guide, prior, objective and kind of scales: what fits learns, what does not says so."""

from __future__ import annotations

import itertools
import math
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hydra
import pyro
import pytest
import torch
from omegaconf import DictConfig

from cavin_pyro import building
from cavin_pyro.elbo import elbo_terms
from cavin_pyro.errors import UserError
from cavin_pyro.training import Trainer, TrainerSettings
from cavin_pyro.windows import WindowSettings, WindowTable, load_windows
from models.pointnet import PointNet

CONF = Path(building.__file__).parent / "conf"
MODELS, GUIDES, PRIORS, OBJECTIVES, SCALES = (
    sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    for group in ("model", "guide", "prior", "objective", "scales")
)
FITTING = {
    "cascaded": {"cascaded", "mean_field", "joint", "flow"},
    "single_latent": {"single_latent"},
    "flat": {"flat"},
    "dynamics": {"none"},
}
WITHOUT_CODES = {("dynamics", "none", "standard", "trace_elbo"), ("dynamics", "none", "standard", "mean_field_elbo")}
ALL = list(itertools.product(MODELS, GUIDES, PRIORS, OBJECTIVES))
VALID = [words for words in ALL if words[1] in FITTING[words[0]] and (words[0] != "dynamics" or words in WITHOUT_CODES)]
STEPS = TrainerSettings(steps=200, batch_size=16, learning_rate=3e-3, validate_every=200, validation_windows=64)


def composed(model: str, guide: str, prior: str, objective: str, scales: str = "fixed") -> DictConfig:
    words = [f"model={model}", f"guide={guide}", f"prior={prior}", f"objective={objective}", f"scales={scales}"]
    words += ["model.width=8", *(["guide.width=8"] if guide != "none" else [])]
    words += ["objective.elbo.num_particles=2"] if objective == "iwae" else []
    with hydra.initialize_config_module("cavin_pyro.conf", version_base="1.3"):
        return hydra.compose("train", overrides=words)


@pytest.fixture(scope="module")
def windows(pushes: Path, tmp_path_factory: pytest.TempPathFactory) -> WindowTable:
    torch.manual_seed(0)
    own = shutil.copytree(pushes, tmp_path_factory.mktemp("combinations") / "pushes")  # features go there
    settings = WindowSettings(validation_fraction=0.4, minimum_move=0.001, quiet_fraction=1.0, seed=1)
    return load_windows([own], PointNet().requires_grad_(False).eval(), settings)


def validation_loss(model: Any, guide: Any, table: WindowTable) -> float:
    torch.manual_seed(3)
    with torch.no_grad():
        return sum(value.item() for value in elbo_terms(model, guide, table.batch(table.validation)).values())


def losses(config: DictConfig, table: WindowTable, folder: Path) -> tuple[float, float]:
    """On held-out windows, before and after 200 steps."""
    torch.manual_seed(0)
    with pyro.settings.context(
        module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False
    ):
        model = building.build_model(config)
        guide = building.build_guide(config, model)
        objective = building.build_objective(config, model)
        before = validation_loss(model, guide, table)
        Trainer(model, guide, objective, table, STEPS, folder, lambda step, row: None).run()
        return before, validation_loss(model, guide, table)


def test_the_words_are_all_there() -> None:
    assert set(MODELS) == set(FITTING)
    assert set(GUIDES) == set().union(*FITTING.values())
    assert {"standard", "conditional", "flow"} <= set(PRIORS)
    assert {"trace_elbo", "mean_field_elbo", "iwae", "counterfactual"} <= set(OBJECTIVES)


@pytest.mark.parametrize("words", VALID, ids="-".join)
def test_what_fits_learns(words: tuple[str, str, str, str], windows: WindowTable, tmp_path: Path) -> None:
    before, after = losses(composed(*words), windows, tmp_path)
    assert math.isfinite(after) and after < before - 1


@pytest.mark.parametrize("model", MODELS)
def test_what_does_not_fit_says_so_in_one_line(model: str) -> None:
    for words in ALL:
        if words[0] == model and words not in VALID:
            config = composed(*words)
            with pytest.raises(UserError, match=r"(choose|leave)") as caught:
                program = building.build_model(config)
                building.build_guide(config, program)
                building.build_objective(config, program)
            assert "\n" not in str(caught.value)


@pytest.mark.parametrize("model", MODELS)
def test_learned_scales_learn_with_every_model(model: str, windows: WindowTable, tmp_path: Path) -> None:
    guide = sorted(FITTING[model])[0]
    before, after = losses(composed(model, guide, "standard", "trace_elbo", "learned"), windows, tmp_path)
    assert math.isfinite(after) and after < before - 1


@pytest.mark.parametrize("word", ["objective.warm_up_steps=100", "objective.kl_weights.effect_code=0.5"])
def test_weighted_kl_terms_learn(word: str, windows: WindowTable, tmp_path: Path, small: SimpleNamespace) -> None:
    config = composed("cascaded", "cascaded", "standard", "trace_elbo")
    section, _, value = word.rpartition("=")
    config_section: Any = config.objective
    *path, last = section.split(".")[1:]
    for name in path:
        config_section = config_section[name]
    config_section[last] = type(config_section[last])(value)
    before, after = losses(config, windows, tmp_path)
    assert math.isfinite(after) and after < before - 1
