"""`planner=` and `planner.optimizer=` with checkpoints of every model: compatible ones plan, others are refused."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pyro
import pytest
import torch
from omegaconf import OmegaConf

import cavin_pyro
from cavin_pyro.config import parts as building
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.factory import EpisodeRunner, make_runner
from cavin_pyro.evaluation.rollout import OUTCOMES
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.models.state import State
from cavin_pyro.planning import CavinPlanner
from cavin_pyro.planning.additions import FirstPush
from cavin_pyro.planning.optimizers import OPTIMIZERS
from cavin_pyro.storage.checkpoint import save
from cavin_pyro.visualization.drawing import draw_episode

rollout = partial(cavin_pyro.rollout, pushes_per_plan=None)  # executes all T pushes of a plan
FITTING = {
    "cavin": "cascaded",
    "cavin_without_effects": "cascaded",
    "sectar": "single_latent",
    "cvae_mpc": "flat",
    "mpc": "dynamics",
}
MODELS = sorted({*FITTING.values()})
SMALL = ["maximum_steps=3", "objects=2", "planner.samples=16", "planner.horizon=6"]


def save_untrained(path: Path, *further: str) -> Path:
    """A very small checkpoint, as train writes it."""
    composed = compose("train", "guide=none", "model.width=8", *further)
    config = {part: OmegaConf.to_container(composed[part], resolve=True) for part in ("model", "prior", "scales")}
    with torch.random.fork_rng(), pyro.settings.context(module_local_params=True):
        parts = {"model": building.build_model(config), "geometry": PointNet()}
        save(path, **parts, config=config, provenance={"step": 0})
    return path


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """An untrained checkpoint of every model."""
    folder = tmp_path_factory.mktemp("models")
    return {name: save_untrained(folder / f"{name}.safetensors", f"model={name}") for name in MODELS}


@pytest.fixture
def make_small_runner(checkpoints: dict[str, Path]) -> Callable[..., EpisodeRunner]:
    def make(planner: str, model: str, *further: str) -> EpisodeRunner:
        overrides = [f"planner={planner}", f"checkpoint={checkpoints[model]}", *SMALL, *further]
        return make_runner(compose("evaluate", *overrides, "output=unused"))

    return make


@pytest.mark.parametrize(("pushes", "tracked"), [("1", True), ("2", False), ("null", False)])
def test_the_first_push_is_tracked_where_it_alone_is_executed(
    pushes: str, tracked: bool, make_small_runner: Callable[..., EpisodeRunner]
) -> None:
    runner = make_small_runner("cavin", "cascaded", f"pushes_per_plan={pushes}")
    assert isinstance(runner.planner, CavinPlanner)
    assert (FirstPush() in runner.planner.additions) is tracked
    runner.env.close()


# Every optimizer with Algorithm 1, and another one with each of the other planners.
PAIRS = [("cavin", name) for name in OPTIMIZERS] + list(zip(sorted(FITTING), sorted(OPTIMIZERS), strict=False))


@pytest.mark.parametrize(("planner", "optimizer"), PAIRS)
def test_every_planner_plans_with_every_optimizer(
    planner: str, optimizer: str, make_small_runner: Callable[..., EpisodeRunner], tmp_path: Path
) -> None:
    parts = make_small_runner(planner, FITTING[planner], f"planner.optimizer={optimizer}")
    episode = rollout(parts.env, parts.planner, seed=1)
    assert episode.outcome in OUTCOMES
    plan = episode.plan_records[0].plan
    assert plan.actions.shape == (1, 3, 4)
    assert plan.actions.isfinite().all()
    assert plan.candidate_centers.shape[2:] == (2, 2, 3)
    draw_episode(tmp_path / "plan.png", episode, parts.env)
    parts.env.close()


@pytest.mark.parametrize(
    ("planner", "option"),
    [
        ("cavin", "planner.reward_at=subgoals"),
        ("cavin", "planner.optimizer.replacement=false"),
        ("cavin", "planner.motion_optimizer=cem"),
        ("cavin", "planner.drop=[early_stopping]"),
        ("cavin", "planner.motion_share=0.02"),
        # perturbed rollouts are made of plans that reach the goal: here some do
        ("cavin_without_effects task=clearing planner.horizon=30 objects=1", "planner.drop=[perturbed_rollouts]"),
        ("cvae_mpc task=clearing planner.horizon=30", "planner.drop=[perturbed_rollouts]"),
    ],
)
def test_options_take_effect(planner: str, option: str) -> None:
    plans = []
    for further in ([], [option]):
        name, *own = planner.split()
        overrides = [f"planner={name}", *SMALL, "planner.samples=64", *own, *further, "output=unused"]
        parts = make_runner(compose("evaluate", *overrides))  # the shipped checkpoint knows something
        plans.append(rollout(parts.env, parts.planner, seed=1).plan_records[0].plan)
        parts.env.close()
    returns, actions = ([getattr(plan, name) for plan in plans] for name in ("candidate_returns", "actions"))
    assert not (torch.equal(*returns) and torch.equal(*actions))


@pytest.mark.parametrize("planner", ["cavin", "paper", "sectar", "cvae_mpc", "mpc", "cavin_without_effects"])
def test_what_is_executed_is_what_f_was_asked_and_lies_in_the_action_box(
    planner: str, make_small_runner: Callable[..., EpisodeRunner], monkeypatch: pytest.MonkeyPatch
) -> None:
    runner = make_small_runner(planner, FITTING.get(planner, "cascaded"), "maximum_steps=2", "margin=0")
    model, asked = runner.planner.model, []  # type: ignore[attr-defined]

    def next_state(state: State, action: torch.Tensor) -> State:
        asked.append(action.reshape(-1, 4))
        return usual(state, action)

    usual = model.next_state
    monkeypatch.setattr(model, "next_state", next_state)
    executed = runner.rollout(1).transitions
    rows = torch.cat(asked)
    assert rows.abs().max() <= 1.0
    assert {one.action.tobytes() for one in executed} <= {row.numpy().tobytes() for row in rows}
    runner.env.close()


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("planner", sorted(FITTING))
def test_a_planner_names_the_model_that_it_needs(
    planner: str, model: str, make_small_runner: Callable[..., EpisodeRunner]
) -> None:
    if planner == "mpc" or FITTING[planner] == model:  # all models have dynamics
        make_small_runner(planner, model).env.close()
    else:
        with pytest.raises(UserError, match=f"needs a checkpoint of model={FITTING[planner]}, not "):
            make_small_runner(planner, model)


def test_an_episode_from_python_is_that_of_the_command(checkpoints: dict[str, Path]) -> None:
    world = {"task": "insertion", "reward": "dense", "objects": 2, "maximum_steps": 3, "seed": 4}
    options = {"samples": 16, "horizon": 6}
    config = compose("plan", **world, checkpoint=str(checkpoints["cascaded"]), planner=options)
    runner, trained = make_runner(config), cavin_pyro.load(checkpoints["cascaded"])
    env = cavin_pyro.make_env(**world, geometry=trained.geometry)
    planner = cavin_pyro.make_planner(trained.model, seed=4, **options)
    one, other = runner.rollout(4), cavin_pyro.rollout(env, planner, seed=4)
    assert [step.action.tolist() for step in one.transitions] == [step.action.tolist() for step in other.transitions]
    assert len(one.plan_records) == len(one.transitions) and one.total_reward == other.total_reward
    runner.env.close(), env.close()
    for model, wrong, said in (
        (None, {}, "needs a model: give cavin_pyro.load"),
        (trained.model, {"planner": {}}, "a section with _target_, not empty"),
        (trained.model, {"samplez": 3}, "planner.samplez"),
        (trained.model, {"samples": 0}, "samples must be a whole number of at least 1, not 0"),
        (trained.model, {"pushes_per_plan": 99}, "pushes_per_plan must be a whole number .* at most 3, not 99"),
    ):
        with pytest.raises(UserError, match=said):
            cavin_pyro.make_planner(model, **wrong)
    with pytest.raises(ValueError, match="CavinPlanner needs a model as cascaded; .* has no effect_prior"):
        CavinPlanner(cavin_pyro.load(checkpoints["flat"]).model)
    with pytest.raises(UserError, match="planner must be a Planner, as of make_planner, not the class CavinPlanner"):
        cavin_pyro.rollout(env, CavinPlanner, seed=0)
