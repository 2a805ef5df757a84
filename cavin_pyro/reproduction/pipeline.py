"""The pipeline: a killed run resumes where it stopped, without repeating finished work."""

from __future__ import annotations

import functools
import shlex
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig

from cavin_pyro.config.application import Interruption
from cavin_pyro.config.composition import compose
from cavin_pyro.config.device import set_matmul_precision
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.evaluation import run_missing
from cavin_pyro.launching.workers import of_shard, run_jobs
from cavin_pyro.reproduction.cells import SCENES_PER_TRAINING, Cell, cells
from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.reproduction.sizes import SIZES, Size
from cavin_pyro.reproduction.table import TABLE, as_table, episode_row, write_table
from cavin_pyro.storage.files import clear_abandoned
from cavin_pyro.storage.progress import progress_bar
from cavin_pyro.storage.run_directory import write_config

SHARED = ("reward=sparse", "criterion=published", "env.segmentation=clusters")  # options of every evaluation
RESULTS = {"pretrain": "metrics.json", "train": "training.png"}  # written last; collect itself knows a whole dataset


@dataclass(frozen=True)
class Stage:
    """A command before the evaluation, and the folder where it writes."""

    command: str
    options: tuple[str, ...]
    folder: Path


def run_pipeline(config: DictConfig, home: Path, device: str = "cpu") -> pd.DataFrame:
    """Collect, pretrain, train and evaluate, as far as that has not been done, and write the table of episodes.

    Args:
        config: of the command `reproduce`. `shard=i/n`: the i-th of every n trainings and their episodes only.
            With more `episodes` or other `planners` than an earlier run, only what is missing is run.
        device: cpu or cuda, on which networks are trained and plan; collection runs on the CPU.

    Raises UserError: an option that cannot be used, or a stage that failed.
    """
    size = chosen_size(config)
    if not config.models:
        run_stages(preparation(size, home, config.methods, workers=config.workers, device=device), 1)
        trainings = [training(size, home, *one, device=device) for one in chosen_trainings(size, config)]
        run_stages(trainings, config.workers)
    evaluations = dict(_evaluations(size, config, home, device))
    for own in evaluations.values():
        folder = Path(own.output)
        folder.mkdir(parents=True, exist_ok=True)
        clear_abandoned(folder)
        write_config(folder, own)
    found = run_missing(list(evaluations.values()), config.workers)
    table = as_table(episode_row(cell, row) for cell, rows in zip(evaluations, found, strict=True) for row in rows)
    write_table(home / TABLE, table)
    return table


def chosen_size(config: DictConfig) -> Size:
    """The size that `scale` names, with the given episodes, scenes, tasks, rewards and numbers of objects.

    Raises UserError: more episodes than there are scenes.
    """
    size = SIZES[config.scale]
    names = ("episodes", "bottom_episodes", "first_scene", "priors")
    given = {name: config[name] for name in names if config[name] is not None}
    most = SCENES_PER_TRAINING * len(size.training_seeds)
    for name in ("episodes", "bottom_episodes"):
        if given.get(name, 0) > most:
            raise UserError(f"{name} must be at most {most} with scale={config.scale}, not {given[name]}")
    tasks = tuple(one for one in size.tasks if one in config.tasks)
    counts = tuple(one for one in size.object_counts if one in config.objects)
    return replace(size, **given, tasks=tasks, object_counts=counts, rewards=tuple(config.rewards))


def chosen_trainings(size: Size, config: DictConfig) -> Sequence[tuple[str, int]]:
    """The method and the seed of each training in the option `shard`."""
    return of_shard([(name, seed) for seed in size.training_seeds for name in config.methods], config.shard)


def chosen_cells(size: Size, config: DictConfig) -> list[Cell]:
    """The cells of the chosen trainings."""
    own = set(chosen_trainings(size, config))
    return [cell for cell in cells(size, config.methods, config.planners) if (cell.method, cell.training_seed) in own]


def check_inputs(config: DictConfig) -> None:
    """Check what a run reads and chooses, before it writes anything.

    Raises UserError: an option that cannot be used, or a model that is missing.
    """
    wanted = chosen_cells(chosen_size(config), config)
    if not wanted:
        raise UserError(f"no cell of scale={config.scale} has these methods, planners, tasks, objects and rewards")
    for path in (checkpoint_of(cell, Path(), config.models) for cell in wanted):
        if config.models and not path.is_file():
            raise UserError(f"models={config.models} holds no {path.name}: choose other methods, or train it")


def preparation(size: Size, home: Path, methods: Sequence[str], *, workers: int, device: str = "cpu") -> list[Stage]:
    """Data, then the PointNet that the methods share, if one reads it; `device`: of the latter's training."""
    collect = Stage(
        "collect", (f"transitions={size.transitions}", *size.collection, f"workers={workers}"), home / "data"
    )
    pretrain = Stage("pretrain", (f"data={home / 'data'}", *size.pretraining, f"device={device}"), home / "pretrain")
    return [collect, pretrain] if any(METHODS[name].reads_point_clouds for name in methods) else [collect]


def training(size: Size, home: Path, name: str, seed: int, *, device: str = "cpu") -> Stage:
    """A method with a training seed, on the data and features of all."""
    method, pointnet = METHODS[name], home / "pretrain" / "pointnet.safetensors"
    inputs = (f"data={home / 'data'}", *([f"pointnet={pointnet}"] if method.reads_point_clouds else []))
    chosen = (f"prior={size.priors}", *method.training, *(() if size.priors == "standard" else method.tuned))
    options = (*inputs, *size.training, *chosen, f"seed={seed}", f"device={device}")
    return Stage("train", options, home / "train" / f"{name}-{seed}")


def checkpoint_of(cell: Cell, home: Path, models: str | None) -> Path:
    """What a cell plans with: of the folder `models`, or of this run's trainings."""
    name = f"{cell.method}-{cell.training_seed}"
    return Path(models) / f"{name}.safetensors" if models else home / "train" / name / "checkpoint.safetensors"


def run_stages(stages: Sequence[Stage], workers: int) -> None:
    """Run what is unfinished in their order, `workers` at a time; a UserError: one has failed."""
    unfinished = [stage for stage in stages if not (stage.folder / RESULTS.get(stage.command, "")).is_file()]
    with (
        closing(run_jobs(run_stage, unfinished, workers)) as finished,
        progress_bar(stages[-1].command, total=len(unfinished), unit="run") as bar,
    ):
        for _ in finished:
            bar.update()


def run_stage(stage: Stage) -> Path:
    """Run a command in this process; returns its folder, where `log.txt` has what it prints.

    Raises UserError: it failed. KeyboardInterrupt: a signal ended it.
    """
    set_matmul_precision("float32")  # which a training here before may have changed
    stage.folder.mkdir(parents=True, exist_ok=True)
    log = stage.folder / "log.txt"
    sys.argv = [f"cavin_pyro/{stage.command}.py", *stage.options, f"output={stage.folder}"]
    try:
        with open(log, "a", encoding="utf-8") as file, redirect_stdout(file), redirect_stderr(file):
            import_module(f"cavin_pyro.{stage.command}").main()
    except SystemExit as end:
        if end.code in (129, 130, 143):  # SIGHUP, SIGINT, SIGTERM
            raise Interruption(signal.Signals(end.code - 128)) from end
        last = log.read_text(encoding="utf-8").strip().splitlines()[-1].removeprefix("error: ")
        line = shlex.join(["python", "-m", f"cavin_pyro.{stage.command}", *sys.argv[1:]])
        raise UserError(f"{line} failed: {last} ({log})") from end
    return stage.folder


def _evaluations(size: Size, config: DictConfig, home: Path, device: str) -> Iterator[tuple[Cell, DictConfig]]:
    """The options of every evaluation, composed once for each method, planner and task, because that takes time."""
    composed = functools.cache(functools.partial(compose, "evaluate"))
    for cell in chosen_cells(size, config):
        planner = METHODS[cell.method].planners[cell.planner]
        own = composed(f"task={cell.task}", *SHARED, *planner, *size.planning, f"device={device}", "output=-").copy()
        for name in ("reward", "objects", "seed", "episodes"):
            own[name] = getattr(cell, name)
        own.checkpoint = str(checkpoint_of(cell, home, config.models))
        own.output = str(home / "evaluate" / cell.name)
        yield cell, own
