"""Small datasets and checkpoints, made once per test process, and helpers that run the commands."""

from __future__ import annotations

import atexit
import functools
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyro
import pytest
import torch
from omegaconf import DictConfig

from cavin_pyro.config.composition import compose
from cavin_pyro.config.parts import build_guide, build_model
from cavin_pyro.data.collection import CollectionConfig, collect
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.storage.checkpoint import save
from tests.cavin_pyro.shell import ENVIRONMENT, ROOT, Answer, complaints

SMALL_CHECK = [  # options that make a check of all sections a matter of seconds
    *("windows=5", "sizes.guide.samples=8", "sizes.guide.particles=20", "sizes.predictive.replicates=4"),
    *("sizes.intervals.samples=8", "sizes.subgoals.scenes=1", "sizes.subgoals.objects=2", "sizes.subgoals.samples=2"),
]
WINDOWS = {  # of a training on `pushes`
    "validation_fraction": 0.4,
    "maximum_step": 0.2,
    "minimum_move": 0.001,
    "maximum_move": 0.5,
    "negative_fraction": 0.25,
}
PUSHES = CollectionConfig(seed=3, steps=6, episodes_per_shard=4)  # 3 shards of the data that tests share


def ended(
    main: Callable[[], None], words: Sequence[object], patch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> tuple[int, str, str]:
    """Run a command in this process; its exit status, output, and errors without progress bars."""
    patch.setattr(sys, "argv", [*map(str, words)])
    status = 0
    try:
        main()
    except SystemExit as stop:
        status = int(stop.code or 0)
    output, errors = capsys.readouterr()
    return status, output, "\n".join(line for line in errors.splitlines() if line.startswith("error:"))


@dataclass(frozen=True)
class Case:
    """A command to be run in a folder of its own."""

    command: str
    overrides: Sequence[str]


def start_command(command: str, *overrides: str, folder: Path, quiet: bool = False) -> subprocess.Popen[str]:
    """Begin a command as a user does, from the folder; `quiet` for those that are to be killed."""
    pipe = subprocess.DEVNULL if quiet else subprocess.PIPE
    line = [sys.executable, "-m", f"cavin_pyro.{command}", *overrides]
    return subprocess.Popen(line, cwd=folder, env=ENVIRONMENT, stdout=pipe, stderr=pipe, text=True)


def run_as_users(command: str, *overrides: str, folder: Path) -> Answer:
    """Run a command with an interpreter of its own, from the folder, and with the limits of this process."""
    with start_command(command, *overrides, folder=folder) as process:
        try:
            output, errors = process.communicate(timeout=300)
        finally:
            process.kill()
    return Answer(process.returncode, output, errors)


def run_command(
    command: str,
    *overrides: str,
    folder: Path,
    file_limit: int | None = None,
    kill_at: tuple[str, int] | None = None,
    pictures: str = "drawn",
) -> Answer:
    """Run a command in a process of its own, from the folder, without waiting for its imports (command_server.py).

    Args:
        file_limit: bytes beyond which a file cannot grow.
        kill_at: a file, and how many lines it has when the command is killed.
        pictures: are `drawn` or left `blank`.
    """
    job = {"command": command, "overrides": overrides, "file_limit": file_limit}
    job |= {"kill_at": kill_at, "pictures": pictures}
    status, output, errors = _forked(job, folder)
    return Answer(status, output, errors)


def run_script(path: Path, *arguments: str, folder: Path) -> Answer:
    """Run a script that is no part of a package, as `python path arguments` from the folder, likewise forked."""
    status, output, errors = _forked({"script": str(path), "overrides": arguments}, folder)
    return Answer(status, output, errors)


def run_in_turn(cases: Mapping[str, Case], folder: Path, *, pictures: str = "drawn") -> dict[str, Answer]:
    """Run many commands in one process, each from `folder / its name`; pictures are `drawn` or left `blank`."""
    jobs = [
        {"command": case.command, "overrides": list(case.overrides), "folder": str(folder / name)}
        for name, case in cases.items()
    ]
    status, output, errors = _forked({"cases": jobs, "pictures": pictures}, folder)
    assert status == 0, errors
    answers: list[dict[str, Any]] = json.loads(output.splitlines()[-1])
    return {name: Answer(**answer) for name, answer in zip(cases, answers, strict=True)}


def _forked(job: Mapping[str, Any], folder: Path) -> tuple[int, str, str]:
    """Exit status, output and errors of a job of the command server."""
    server = _command_server()
    assert server.stdin is not None and server.stdout is not None
    with tempfile.TemporaryDirectory() as kept:
        output, errors = Path(kept) / "output", Path(kept) / "errors"
        print(
            json.dumps({**job, "folder": str(folder), "output": str(output), "errors": str(errors)}), file=server.stdin
        )
        server.stdin.flush()
        status = int(server.stdout.readline())
        return status, output.read_text(), errors.read_text()


@functools.cache
def _command_server() -> subprocess.Popen[str]:
    """One for each process of the tests; it ends when that closes its input."""
    line = [sys.executable, "-m", "tests.cavin_pyro.command_server"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    server = subprocess.Popen(line, cwd=ROOT, env=ENVIRONMENT, text=True, **pipes)
    atexit.register(server.communicate)
    return server


def small_parts(seed: int = 0) -> dict[str, torch.nn.Module]:
    """An untrained cascade of width 8."""
    torch.manual_seed(seed)
    model = CascadedModel(space=SPACE, effect_dimension=4, motion_dimension=4, width=8)
    return {"model": model, "guide": CascadedGuide(model, width=8), "geometry": PointNet()}


def small_config() -> dict[str, Any]:
    """How to build `small_parts` again."""
    sizes = {"effect_dimension": 4, "motion_dimension": 4, "feature_dimension": 64, "width": 8, "maximum_objects": 5}
    return {
        "model": {"_target_": "cavin_pyro.models.cascaded.CascadedModel", "segment_length": 3, **sizes},
        "guide": {"_target_": "cavin_pyro.guides.cascaded.CascadedGuide", "width": 8},
        "prior": {"_target_": "cavin_pyro.models.priors.standard.StandardPrior"},
        "scales": {"_target_": "cavin_pyro.models.likelihoods.LikelihoodScales"},
    }


BASELINES = {  # model= and the class of its guide, with what its section of the configuration has
    "flat": (
        "cavin_pyro.guides.flat.FlatGuide",
        {"_target_": "cavin_pyro.models.flat.FlatModel", "motion_dimension": 4},
    ),
    "single_latent": (
        "cavin_pyro.guides.single_latent.SingleLatentGuide",
        {"_target_": "cavin_pyro.models.single_latent.SingleLatentModel", "effect_dimension": 4},
    ),
    "dynamics": ("cavin_pyro.guides.none.NoGuide", {"_target_": "cavin_pyro.models.dynamics_only.DynamicsModel"}),
}


def save_baseline(path: Path, name: str, **more: Any) -> None:
    """A checkpoint of another model than the cascade, untrained and small; `more` goes into its configuration."""
    guide, model = BASELINES[name]
    config = {**small_config(), **more, "guide": {"_target_": guide, **({} if name == "dynamics" else {"width": 8})}}
    config["model"] = {**model, "segment_length": 3, "feature_dimension": 64, "width": 8, "maximum_objects": 5}
    built = build_model(config)
    parts = {"model": built, "guide": build_guide(config, built), "geometry": PointNet()}
    save(path, **parts, config=config, provenance={"step": 0})


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, by its name."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="session")
def shell() -> SimpleNamespace:
    """Ways to run the commands."""
    names: list[Callable] = [Case, complaints, contents, run_as_users, run_command, run_in_turn, start_command]
    return SimpleNamespace(**{name.__name__: name for name in names})


@pytest.fixture(scope="session")
def small() -> SimpleNamespace:
    """Small things to try."""
    return SimpleNamespace(
        config=small_config, parts=small_parts, pushes=PUSHES, baselines=[*BASELINES], save_baseline=save_baseline
    )


@pytest.fixture(autouse=True)
def clean_pyro() -> Iterator[None]:
    pyro.clear_param_store()
    torch.manual_seed(0)
    # Setting up an episode changes the other two as well, which must not outlive the test.
    kept = {name: pyro.settings.get(name) for name in ("validate_distributions_pyro", "validate_distributions_torch")}
    with pyro.settings.context(module_local_params=True, **kept):
        yield
    pyro.clear_param_store()


@pytest.fixture(scope="session")
def pushes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of 12 episodes in 3 shards, to be read only; training adds its features."""
    folder = tmp_path_factory.mktemp("data") / "pushes"
    folder.mkdir()
    metadata = collect(PUSHES, folder, transitions=60, workers=1)
    assert metadata["shards"] == 3
    return folder


@pytest.fixture
def own_pushes(pushes: Path, tmp_path: Path) -> Path:
    """A copy of the dataset as it was collected, to be spoilt."""
    return shutil.copytree(pushes, tmp_path / "pushes", ignore=shutil.ignore_patterns("features-*"))


@pytest.fixture(scope="session")
def checkpoint_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint as train writes it, of an untrained and very small cascade; to be read only."""
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.safetensors"
    with torch.random.fork_rng(), pyro.settings.context(module_local_params=True):
        save(path, **small_parts(), config=small_config(), provenance={"step": 0})
    return path


@pytest.fixture(scope="session")
def configure(checkpoint_file: Path) -> Callable[..., DictConfig]:
    """The configuration of a short evaluation in one process, with further overrides."""

    def configuration(*overrides: str) -> DictConfig:
        few = ["maximum_steps=4", "workers=1", "episodes=3", "objects=2", "output=unused"]
        return compose("evaluate", f"checkpoint={checkpoint_file}", *few, *overrides)

    return configuration
