"""The pipeline: a killed run resumes where it stopped, without repeating finished work."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from tqdm import tqdm

from cavin_pyro.config.commands.reproduction import ReproduceConfig
from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.evaluation import append, begin, missing_seeds, run_jobs, seeds_of
from cavin_pyro.launching.launcher import of_shard
from cavin_pyro.reproduction.cells import FIGURES, SCENES_PER_TRAINING, Evaluation, evaluations, in_order
from cavin_pyro.reproduction.methods import METHODS, chosen_methods
from cavin_pyro.reproduction.scales import OBJECT_COUNTS, SCALES, Scale
from cavin_pyro.reproduction.stages import Stage, preparation, run_stages, training_folder, trainings
from cavin_pyro.reproduction.table import TABLE, Row, episode_key, episode_row, read_table, row_key, write_table
from cavin_pyro.storage.files import clear_abandoned
from cavin_pyro.storage.run_directory import write_config

ROUND = 5  # episodes of one evaluation before the next one's turn
SHARED = ("reward=sparse", "criterion=published", "env.segmentation=clusters")  # options of every evaluation


def run_pipeline(config: DictConfig, home: Path, device: str = "cpu") -> list[Row]:
    """Collect, pretrain, train and evaluate, as far as that has not been done, and write the table of episodes.

    Args:
        config: of the command `reproduce`. `shard=i/n`: the i-th of every n trainings and their episodes only.
            With more `episodes` or other `planners` than an earlier run, only what is missing is run; `extends` names
            the table of a run whose folder is elsewhere, and whose episodes are kept, wanted or not.
        device: cpu or cuda, on which networks are trained and plan; collection runs on the CPU.

    Returns:
        The table's rows.

    Raises:
        UserError: an option that cannot be used, or a stage that failed.
    """
    scale = chosen_scale(config)
    methods = chosen_methods(config)
    first = preparation(scale, home, methods, workers=config.workers, device=device)
    learning = of_shard(trainings(scale, home, methods, device=device), config.shard)
    folders = {stage.folder for stage in learning}
    own = [
        one
        for one in evaluations(scale, methods, config.planners)
        if training_folder(home, one.cell.method, one.training_seed) in folders
    ]
    # Each group needs the one before it.
    groups = [] if config.models else [*([stage] for stage in first), learning]
    models = _models(config, home, own)
    known = _known(config, scale)
    flat = [stage for group in groups for stage in group]
    with _whole_progress(flat, scale, own, home, config.workers, known) as bar:
        for stages in groups:
            run_stages(stages, config.workers, bar.update_stages)
        rows = _evaluate(scale, own, home, models, device, config.workers, bar, known)
    own_keys = {row_key(row) for row in rows}
    rows = in_order([*rows, *(row for key, row in known.items() if key not in own_keys)], SCALES[config.scale])
    write_table(home / TABLE, rows)
    return rows


def chosen_scale(config: DictConfig) -> Scale:
    """The scale by its name, with the given episodes, scenes, tasks, rewards and numbers of objects.

    Raises:
        UserError: more episodes than there are scenes, or no task or number of objects that the scale has.
    """
    scale = SCALES[config.scale]
    names = ("episodes", "bottom_episodes", "first_scene")
    given = {name: config[name] for name in names if config[name] is not None}
    most = SCENES_PER_TRAINING * len(scale.training_seeds)
    for name, value in given.items():
        if name != "first_scene" and value > most:
            raise UserError(f"{name} must be at most {most} with scale={config.scale}, not {value}")
    if odd := [one for one in config.objects if one not in OBJECT_COUNTS]:
        raise UserError(f"objects has {odd[0]}: choose from {', '.join(map(str, OBJECT_COUNTS))}")
    for name, own in (("tasks", scale.tasks), ("objects", scale.object_counts)):
        if not set(own) & set(config[name]):
            raise UserError(f"{name} has none of scale={config.scale}: choose from {', '.join(map(str, own))}")
    tasks = tuple(one for one in scale.tasks if one in config.tasks)
    counts = tuple(one for one in scale.object_counts if one in config.objects)
    return replace(scale, **given, tasks=tasks, object_counts=counts, rewards=tuple(config.rewards))


def check_inputs(config: DictConfig) -> None:
    """Check what a run reads and chooses, before it writes anything.

    Raises:
        UserError: an option that cannot be used, a model or a table that is missing.
    """
    scale = chosen_scale(config)
    for name in ("methods", "planners", "rewards"):
        if config[name] is not None and not config[name]:
            raise UserError(f"{name}=[] leaves nothing to run: choose some, or leave the option out")
    of_shard(trainings(scale, Path(), chosen_methods(config)), config.shard)
    wanted = list(evaluations(scale, chosen_methods(config), config.planners))
    if not wanted:
        raise UserError("no cell has these methods, planners and rewards: choose others (variants have sparse rewards)")
    _models(config, Path(), wanted)
    _known(config, scale)


def chosen_rows(rows: Sequence[Row], config: DictConfig) -> list[Row]:
    """The rows of a table that the options `methods`, `planners`, `tasks`, `objects` and `rewards` choose.

    Raises:
        UserError: there is none.
    """
    kinds = {planner: "variants" if planner not in FIGURES else planner for planner in {row["planner"] for row in rows}}
    methods = chosen_methods(config)
    chosen = [
        row
        for row in rows
        if row["method"] in methods
        and kinds[row["planner"]] in config.planners
        and row["task"] in config.tasks
        and row["objects"] in config.objects
        and row["reward"] in config.rewards
    ]
    if not chosen:
        raise UserError(
            f"table={config.table} has no episode of the chosen methods, planners, tasks, objects and rewards: choose "
            "others"
        )
    return chosen


def as_typed(config: DictConfig) -> str:
    """The command that makes the same table, for the page of results."""
    default = ReproduceConfig()
    words = [f"table={config.table}" if config.table else f"scale={config.scale}"]
    chosen = ("methods", "planners", "tasks", "objects", "rewards", "episodes", "bottom_episodes", "first_scene")
    for name in (*chosen, "models", "extends"):
        if config[name] != getattr(default, name):
            value = config[name]
            words.append(f"{name}={value if isinstance(value, int | str) else '[' + ','.join(map(str, value)) + ']'}")
    return shlex.join(["python", "-m", "cavin_pyro.reproduce", *words])


def _models(config: DictConfig, home: Path, own: Sequence[Evaluation]) -> dict[Evaluation, Path]:
    """The checkpoint of every evaluation: of the folder `models`, which must have it, or of this run's trainings.

    Raises:
        UserError: the folder `models` lacks one.
    """
    found = {}
    for one in own:
        method, seed = one.cell.method, one.training_seed
        if config.models:
            found[one] = Path(config.models) / f"{method}-{seed}.safetensors"
            if not found[one].is_file():
                raise UserError(f"models={config.models} holds no {found[one].name}: choose other methods, or train it")
        else:
            found[one] = training_folder(home, method, seed) / "checkpoint.safetensors"
    return found


def _known(config: DictConfig, scale: Scale) -> dict[tuple[Any, ...], Row]:
    """The rows of the table `extends`, by `row_key`.

    Raises:
        UserError: the table has an episode that no run of this scale has.
    """
    if not config.extends:
        return {}
    rows = read_table(Path(config.extends))
    whole = replace(SCALES[config.scale], episodes=1, bottom_episodes=1, first_scene=scale.first_scene)
    own = {episode_key(one, one.seed)[:-1]: one.seed for one in evaluations(whole, list(METHODS))}
    for row in rows:
        first = own.get(row_key(row)[:-1])
        if first is None or not first <= row["seed"] < first + SCENES_PER_TRAINING:
            raise UserError(
                f"extends={config.extends} has scene {row['seed']} of {row['method']} in {row['task']}, which no run "
                f"with scale={config.scale} has: give the scale of that table"
            )
    return {row_key(row): row for row in rows}


def evaluation_folder(home: Path, evaluation: Evaluation) -> Path:
    """Where the episodes of a cell and a training lie."""
    return home / "evaluate" / evaluation.name


def _evaluate(
    scale: Scale,
    own: Sequence[Evaluation],
    home: Path,
    models: Mapping[Evaluation, Path],
    device: str,
    workers: int,
    bar: _Bar,
    known: Mapping[tuple[Any, ...], Row],
) -> list[Row]:
    """The table's rows of all evaluations, whose episodes are one queue, so that no worker waits for a cell's end.

    Episodes of the table `known` are taken from there. The queue goes in rounds over the cells, so that an interrupted
    run has about as many episodes of each.
    """
    rows = {one: begin(_made(evaluation_folder(home, one))) for one in own}
    missing = [
        ((seed - one.seed) // ROUND, place, one, config, seed)
        for place, (one, config) in enumerate(_configurations(scale, own, home, models, device))
        for seed in missing_seeds(seeds_of(config), rows[one])
        if episode_key(one, seed) not in known
    ]
    missing.sort(key=lambda job: (job[0], job[1], job[-1]))
    with closing(run_jobs([(config, seed) for *_, config, seed in missing], workers)) as finished:
        for number, row in finished:
            one = missing[number][2]
            rows[one][row["seed"]] = row
            append(evaluation_folder(home, one), row)
            bar.update(scale.episode_seconds / workers)
    wanted = [(one, seed) for one in own for seed in range(one.seed, one.seed + one.episodes)]
    return [known.get(episode_key(one, seed)) or episode_row(one, rows[one][seed]) for one, seed in wanted]


def _configurations(
    scale: Scale, own: Sequence[Evaluation], home: Path, models: Mapping[Evaluation, Path], device: str
) -> Iterator[tuple[Evaluation, DictConfig]]:
    """The options of every evaluation, composed once for each method, planner and task, because that takes time."""
    composed: dict[tuple[str, str, str], DictConfig] = {}
    for one in own:
        cell = one.cell
        key = cell.method, cell.planner, cell.task
        if key not in composed:
            planner = METHODS[cell.method].planners[cell.planner]
            composed[key] = compose(
                "evaluate", f"task={cell.task}", *SHARED, *planner, *scale.planning, f"device={device}", "output=-"
            )
        config = composed[key].copy()
        config.reward, config.objects = cell.reward, cell.objects
        config.seed, config.episodes = one.seed, one.episodes
        config.checkpoint = str(models[one])
        config.output = str(evaluation_folder(home, one))
        if not (evaluation_folder(home, one) / "config.yaml").exists():
            write_config(evaluation_folder(home, one), config)
        yield one, config


class _Bar:
    """Progress over the whole pipeline, in seconds of one reference machine; the bar scales the time left."""

    def __init__(self, stages: Sequence[Stage], episodes_done: float, episodes: float) -> None:
        self._stages, self._extra = stages, episodes_done
        self._total = total = sum(stage.seconds for stage in stages) + episodes
        self._bar = tqdm(
            desc="reproducing",
            total=total,
            initial=min(self._done(), total),
            file=sys.stderr,
            bar_format="{desc}: {percentage:3.0f}%|{bar}| {elapsed}, {remaining} left",
            mininterval=0.5 if sys.stderr.isatty() else 30.0,
        )

    def _done(self) -> float:
        return sum(stage.seconds_done for stage in self._stages) + self._extra

    def update_stages(self) -> None:
        self._bar.update(max(0.0, min(self._done(), self._total) - self._bar.n))

    def update(self, seconds: float) -> None:
        self._extra += seconds
        self.update_stages()

    def close(self) -> None:
        self._bar.close()


@contextmanager
def _whole_progress(
    stages: Sequence[Stage],
    scale: Scale,
    own: Sequence[Evaluation],
    home: Path,
    workers: int,
    known: Mapping[tuple[Any, ...], Row],
) -> Iterator[_Bar]:
    each = scale.episode_seconds / workers
    done = sum(len(begin(_made(evaluation_folder(home, one)))) for one in own)
    done += sum(episode_key(one, one.seed + place) in known for one in own for place in range(one.episodes))
    bar = _Bar(stages, done * each, sum(one.episodes for one in own) * each)
    try:
        yield bar
    finally:
        bar.close()


def _made(folder: Path) -> Path:
    """A folder beneath the one that this command holds, without what a killed run left half-written."""
    folder.mkdir(parents=True, exist_ok=True)
    clear_abandoned(folder)
    return folder
