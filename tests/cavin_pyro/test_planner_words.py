"""`planner=` and `planner.optimizer=` with checkpoints of every model: what fits plans, what does not says so."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import hydra
import pyro
import pytest
import torch
from omegaconf import OmegaConf

from cavin_pyro import building
from cavin_pyro.checkpoint import save_checkpoint
from cavin_pyro.command import compose
from cavin_pyro.episodes import OUTCOMES, run_episode
from cavin_pyro.errors import UserError
from cavin_pyro.figures_plan import draw_plan
from cavin_pyro.setups import Setup, set_up, tell_of_compiling
from models.pointnet import PointNet
from planning.optimisers import OPTIMISERS
from tests.compiler import needs_a_compiler

FITTING = {
    "cavin": "cascaded",
    "cavin_evolution": "cascaded",
    "sectar": "single_latent",
    "cvae_mpc": "flat",
    "mpc": "dynamics",
}
MODELS = sorted({*FITTING.values()})
SMALL = ["maximum_steps=3", "objects=2", "planner.samples=16", "planner.horizon=6"]


def save_untrained(path: Path, *words: str) -> Path:
    """A very small checkpoint, as train writes it."""
    with hydra.initialize_config_module("cavin_pyro.conf", version_base="1.3"):
        composed = hydra.compose("train", overrides=["guide=none", "model.width=8", *words])
    config = {part: OmegaConf.to_container(composed[part], resolve=True) for part in ("model", "prior", "scales")}
    with torch.random.fork_rng(), pyro.settings.context(module_local_params=True):
        parts = {"model": building.build_model(config), "pointnet": PointNet()}
        save_checkpoint(path, parts=parts, config=config, provenance={"step": 0})
    return path


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """An untrained checkpoint of every model."""
    folder = tmp_path_factory.mktemp("models")
    return {name: save_untrained(folder / f"{name}.safetensors", f"model={name}") for name in MODELS}


@pytest.fixture
def setup(checkpoints: dict[str, Path]) -> Callable[..., Setup]:
    def compose(planner: str, model: str, *words: str) -> Setup:
        overrides = [f"planner={planner}", f"checkpoint={checkpoints[model]}", *SMALL, *words]
        with hydra.initialize_config_module("cavin_pyro.conf", version_base="1.3"):
            return set_up(hydra.compose("evaluate", overrides=[*overrides, "output=unused"]))

    return compose


@pytest.mark.parametrize("optimizer", sorted(OPTIMISERS))
@pytest.mark.parametrize("planner", sorted(FITTING))
def test_every_planner_plans_with_every_optimiser(
    planner: str, optimizer: str, setup: Callable[..., Setup], tmp_path: Path
) -> None:
    parts = setup(planner, FITTING[planner], f"planner.optimizer={optimizer}")
    episode = run_episode(parts.env, parts.planner, parts.pointnet, seed=1)
    assert episode.outcome in OUTCOMES
    plan = episode.decisions[0].plan
    assert plan.actions.shape == (1, 3, 4)
    assert plan.actions.isfinite().all()
    assert plan.candidate_centers.shape[2:] == (2, 2, 3)
    draw_plan(tmp_path / "plan.png", episode, parts.layout, parts.env.scene.camera)
    parts.env.close()


@pytest.mark.parametrize(
    ("planner", "word"),
    [
        ("cavin", "planner.reward_at=subgoals"),
        ("cavin", "planner.stride_limits=[0.1,0.3]"),
        ("cavin", "planner.optimizer_options={replacement:false}"),
        ("cavin", "planner.motion_optimizer=cem"),
        ("cavin", "planner.memory=false"),
        ("cavin", "products=float32"),
        ("cavin_evolution", "planner.optimizer_options={generations:1}"),
        ("cavin", "planner.reachability={_target_:planning.Reachability}"),
        ("mpc", "planner.stride_limits=[0.01,0.15]"),
        ("mpc", "planner.proposal=heuristic"),
    ],
)
def test_options_take_effect(planner: str, word: str) -> None:
    plans = []
    for words in ([], [word]):
        overrides = [f"planner={planner}", *SMALL, "planner.samples=64", *words, "output=unused"]
        with hydra.initialize_config_module("cavin_pyro.conf", version_base="1.3"):
            parts = set_up(hydra.compose("evaluate", overrides=overrides))  # the shipped checkpoint knows something
        plans.append(run_episode(parts.env, parts.planner, parts.pointnet, seed=1).decisions[0].plan)
        parts.env.close()
    returns, actions = ([getattr(plan, name) for plan in plans] for name in ("candidate_returns", "actions"))
    assert not (torch.equal(*returns) and torch.equal(*actions))


@needs_a_compiler
def test_compiled_plans_are_those_of_direct_planning(setup: Callable[..., Setup]) -> None:
    plans = []
    for compile in ("false", "true"):
        words = ["products=float32", "planner.robustness=null", f"planner.compile={compile}", "task=insertion"]
        parts = setup("cavin", "cascaded", *words)
        episode = run_episode(parts.env, parts.planner, parts.pointnet, seed=1)
        plans.append([decision.plan for decision in episode.decisions])
        parts.env.close()
    for direct, compiled in zip(*plans, strict=True):
        torch.testing.assert_close(compiled.candidate_returns, direct.candidate_returns)
        torch.testing.assert_close(compiled.actions, direct.actions, rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(compiled.predicted_centers, direct.predicted_centers, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("planner", ["cavin", "random"])
def test_who_waits_for_compiling_is_told_so(planner: str, capsys: pytest.CaptureFixture[str]) -> None:
    for compile in (False, True):
        words = [f"planner={planner}", *([f"planner.compile={compile}"] if planner == "cavin" else [])]
        tell_of_compiling(compose("evaluate", *words))
        assert capsys.readouterr().err.count("\n") == int(compile and planner == "cavin")


@needs_a_compiler
def test_flows_are_not_compiled(tmp_path: Path) -> None:
    path = save_untrained(tmp_path / "flow.safetensors", "model=cascaded", "prior=flow")
    with hydra.initialize_config_module("cavin_pyro.conf", version_base="1.3"):
        config = hydra.compose("evaluate", overrides=[f"checkpoint={path}", "planner.compile=true", "output=unused"])
    with pytest.raises(UserError, match=r"the priors in .*flow\.safetensors are flows, which cannot be compiled: take"):
        set_up(config)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("planner", sorted(FITTING))
def test_a_planner_names_the_model_that_it_needs(planner: str, model: str, setup: Callable[..., Setup]) -> None:
    if planner == "mpc" or FITTING[planner] == model:  # all models have dynamics
        setup(planner, model).env.close()
    else:
        with pytest.raises(
            UserError, match=f"needs a checkpoint of model={FITTING[planner]}, but .*{model}.safetensors"
        ):
            setup(planner, model)
