"""`planner=` and `planner.optimizer=` with checkpoints of every model: compatible ones plan, others are refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pyro
import pytest
import torch
from omegaconf import OmegaConf

from cavin_pyro.config import parts as building
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.factory import EpisodeRunner, announce_waiting, make_runner
from cavin_pyro.evaluation.rollout import OUTCOMES, rollout
from cavin_pyro.storage import checkpoint
from cavin_pyro.storage.checkpoint import save_checkpoint
from cavin_pyro.visualization.plan import draw_plan
from models.networks.pointnet import PointNet
from planning import CavinPlanner
from planning.optimizers import OPTIMIZERS
from planning.searching import SearchingPlanner
from tests.compiler import needs_a_compiler

FITTING = {
    "cavin": "cascaded",
    "cavin_evolution": "cascaded",
    "cavin_without_effects": "cascaded",
    "sectar": "single_latent",
    "cvae_mpc": "flat",
    "mpc": "dynamics",
}
MODELS = sorted({*FITTING.values()})
SMALL = ["maximum_steps=3", "objects=2", "planner.samples=16", "planner.horizon=6"]


def multiplies_in_bfloat16() -> bool:
    """Whether this processor rounds products to bfloat16 where torch may: not all have instructions for it."""
    left, right = torch.rand(2, 512, 512, generator=torch.Generator().manual_seed(0))
    exact = left @ right
    torch.set_float32_matmul_precision("medium")
    rounded = left @ right
    torch.set_float32_matmul_precision("highest")
    return not torch.equal(exact, rounded)


def save_untrained(path: Path, *further: str) -> Path:
    """A very small checkpoint, as train writes it."""
    composed = compose("train", "guide=none", "model.width=8", *further)
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
def make_small_runner(checkpoints: dict[str, Path]) -> Callable[..., EpisodeRunner]:
    def make(planner: str, model: str, *further: str) -> EpisodeRunner:
        overrides = [f"planner={planner}", f"checkpoint={checkpoints[model]}", *SMALL, *further]
        return make_runner(compose("evaluate", *overrides, "output=unused"))

    return make


@pytest.mark.parametrize(("planner", "model"), [("sectar", "single_latent"), ("cvae_mpc", "flat")])
def test_a_baseline_plans_with_the_checkpoint_of_its_name(
    planner: str, model: str, checkpoints: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(checkpoints[model], tmp_path / f"{planner}.safetensors")
    monkeypatch.setattr(checkpoint, "shipped_folder", lambda: tmp_path)
    runner = make_runner(compose("evaluate", f"planner={planner}", *SMALL, "output=unused"))
    config = checkpoint.load_checkpoint(checkpoints[model]).config
    assert isinstance(runner.planner, SearchingPlanner)
    assert type(runner.planner.model) is type(building.build_model(config))
    runner.env.close()


@pytest.mark.parametrize(
    ("task", "pushes", "tracked"),
    [
        ("clearing", "1", "first_push"),
        ("clearing", "2", "end"),
        ("clearing", "null", "end"),
        ("rearrange", "1", "first_push"),
        ("crossing", "1", "end"),
    ],
)
def test_the_first_push_is_tracked_where_it_alone_is_executed(
    task: str, pushes: str, tracked: str, make_small_runner: Callable[..., EpisodeRunner]
) -> None:
    runner = make_small_runner("cavin", "cascaded", f"task={task}", f"pushes_per_plan={pushes}")
    assert isinstance(runner.planner, CavinPlanner)
    assert runner.planner.distance.at == tracked
    runner.env.close()


# `make test` runs every optimizer with Algorithm 1, and every second of the other planners with one optimizer in turn.
PAIRS = [
    pytest.param(planner, optimizer, marks=() if often else pytest.mark.soak)
    for row, planner in enumerate(sorted(FITTING))
    for column, optimizer in enumerate(sorted(OPTIMIZERS))
    for often in [planner == "cavin" or (column == row % len(OPTIMIZERS) and row % 2)]
]


@pytest.mark.parametrize(("planner", "optimizer"), PAIRS)
def test_every_planner_plans_with_every_optimizer(
    planner: str, optimizer: str, make_small_runner: Callable[..., EpisodeRunner], tmp_path: Path
) -> None:
    parts = make_small_runner(planner, FITTING[planner], f"planner.optimizer={optimizer}")
    episode = rollout(parts.env, parts.planner, parts.geometry, seed=1)
    assert episode.outcome in OUTCOMES
    plan = episode.plan_records[0].plan
    assert plan.actions.shape == (1, 3, 4)
    assert plan.actions.isfinite().all()
    assert plan.candidate_centers.shape[2:] == (2, 2, 3)
    draw_plan(tmp_path / "plan.png", episode, parts.task, parts.env.scene.camera)
    parts.env.close()


@pytest.mark.parametrize(
    ("planner", "option"),
    [
        ("cavin", "planner.reward_at=subgoals"),
        ("cavin", "planner.stride_limits=[0.1,0.3]"),
        ("cavin", "planner.optimizer.replacement=false"),
        ("cavin", "planner.motion_optimizer=cem"),
        ("cavin", "planner.warm_start=false"),
        ("cavin", "planner.motion_samples=1"),
        # perturbed rollouts are made of plans that reach the goal: here some do
        ("cavin_without_effects task=clearing planner.horizon=30 objects=1", "planner.robustness=null"),
        ("cvae_mpc task=clearing planner.horizon=30", "planner.robustness=null"),
        pytest.param(
            "cavin",
            "matmul_precision=bfloat16",
            marks=pytest.mark.skipif(not multiplies_in_bfloat16(), reason="the processor has no bfloat16"),
        ),
        ("cavin_evolution", "planner.optimizer.generations=1"),
        ("mpc", "planner.stride_limits=[0.01,0.15]"),
        ("mpc", "planner.proposal=heuristic"),
    ],
)
def test_options_take_effect(planner: str, option: str) -> None:
    plans = []
    for further in ([], [option]):
        name, *own = planner.split()
        overrides = [f"planner={name}", *SMALL, "planner.samples=64", *own, *further, "output=unused"]
        parts = make_runner(compose("evaluate", *overrides))  # the shipped checkpoint knows something
        plans.append(rollout(parts.env, parts.planner, parts.geometry, seed=1).plan_records[0].plan)
        parts.env.close()
    returns, actions = ([getattr(plan, name) for plan in plans] for name in ("candidate_returns", "actions"))
    assert not (torch.equal(*returns) and torch.equal(*actions))


@pytest.mark.soak  # tests/planning/backends/test_compiled.py compiles a whole planner of a toy model in every run
@needs_a_compiler
def test_compiled_plans_agree_with_eager_plans(make_small_runner: Callable[..., EpisodeRunner]) -> None:
    plans = []
    for compile in ("false", "true"):
        overrides = [
            "matmul_precision=float32",
            "planner.robustness=null",
            f"planner.compile={compile}",
            "task=insertion",
        ]
        parts = make_small_runner("cavin", "cascaded", *overrides)
        episode = rollout(parts.env, parts.planner, parts.geometry, seed=1)
        plans.append([record.plan for record in episode.plan_records])
        parts.env.close()
    for eager, compiled in zip(*plans, strict=True):
        torch.testing.assert_close(compiled.candidate_returns, eager.candidate_returns)
        torch.testing.assert_close(compiled.actions, eager.actions, rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(compiled.predicted_centers, eager.predicted_centers, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("overrides", "slow"),
    [
        ("planner=random", None),
        ("planner.compile=true", None),  # the backend says it, when it finds nothing to load
        ("planner.optimizer=cem", "cem"),
        ("planner=cavin_evolution", "evolution"),
        ("planner.optimizer._target_=tests.Evolution", None),  # a class of the user's own
    ],
)
def test_slow_plans_are_announced(overrides: str, slow: str | None, capsys: pytest.CaptureFixture[str]) -> None:
    announce_waiting(compose("evaluate", overrides))
    said = f"planner.optimizer={slow}: a plan takes about twice as long as with shooting\n" if slow else ""
    assert capsys.readouterr().err == said


@needs_a_compiler
def test_flows_are_not_compiled(tmp_path: Path) -> None:
    path = save_untrained(tmp_path / "flow.safetensors", "model=cascaded", "prior=flow")
    config = compose("evaluate", f"checkpoint={path}", "planner.compile=true", "output=unused")
    with pytest.raises(
        UserError, match=r"the priors in .*flow\.safetensors are flows, which cannot be compiled: choose"
    ):
        make_runner(config)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("planner", sorted(FITTING))
def test_a_planner_names_the_model_that_it_needs(
    planner: str, model: str, make_small_runner: Callable[..., EpisodeRunner]
) -> None:
    if planner == "mpc" or FITTING[planner] == model:  # all models have dynamics
        make_small_runner(planner, model).env.close()
    else:
        with pytest.raises(
            UserError, match=f"needs a checkpoint of model={FITTING[planner]}, but .*{model}.safetensors"
        ):
            make_small_runner(planner, model)
