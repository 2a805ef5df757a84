"""Run the episodes behind the tables: `python benchmarks/episodes.py TABLE --seed FIRST --episodes N`.

A table is a named list of rows, a row a task with options of `evaluate`. Every row meets the scenes FIRST to
FIRST + N - 1. Episodes are added to docs/results/TABLE.parquet as they end; a stopped run resumes, and episodes that
are there are not run again. `--rows NAME ...` restricts the rows. An episode by the published rules gives a second
record, of how it ends by the strict ones. `python benchmarks/tables.py` then writes the tables.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import pyarrow
import torch
from oracle import Oracle
from records import RESULTS, Record, commit, read, write

from cavin_pyro.config.composition import compose
from cavin_pyro.config.recipes import WORLDS as RECIPES
from cavin_pyro.evaluation.evaluation import episode_row
from cavin_pyro.evaluation.factory import EpisodeRunner, make_runner
from cavin_pyro.launching.workers import run_jobs
from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.storage.progress import progress_bar

SCHEMA = pyarrow.schema(
    [
        *((name, pyarrow.string()) for name in ("row", "task")),
        ("objects", pyarrow.int8()),
        ("layout", pyarrow.string()),
        ("tiles", pyarrow.int8()),  # of a generated layout
        *((name, pyarrow.string()) for name in ("planner", "checkpoint", "segmentation", "rules")),
        ("seed", pyarrow.int64()),
        ("outcome", pyarrow.string()),
        ("steps", pyarrow.int16()),
        ("unsafe", pyarrow.int16()),
        ("ineffective", pyarrow.int16()),
        ("planning_ms", pyarrow.list_(pyarrow.float32())),
        ("commit", pyarrow.string()),
    ]
)
WRITE_EVERY = 20  # episodes


@dataclass(frozen=True)
class Row:
    """A line of a table: a task with its number of objects and further options of `evaluate`.

    In other worlds than the tabletop objects are None, and `{}` in the options is the training, `seed % TRAININGS`.
    """

    name: str
    task: str
    objects: int | None = 3
    options: tuple[str, ...] = ()

    def overrides(self, seed: int) -> list[str]:
        """The options of `evaluate` for the scene of that seed."""
        if self.objects is None:
            return [option.replace("{}", str(seed % TRAININGS)) for option in self.options]
        return [f"task={self.task}", f"objects={self.objects}", "reward=sparse", *self.options]


PAPER = ("planner=paper", "planner.motion_horizon=full_horizon", "checkpoint=cavin")
SEEN = ("env.objects=ycb", "env.assets=assets", "env.camera=kinect2", "env.segmentation=clusters")
TASKS = ("clearing", "insertion", "crossing")
MADE = "checkpoint=runs/quickstart/pushes-20-{}/train/checkpoint.safetensors"  # by quickstart seed=0, 1 and 2


def of_each_task(name: str, *options: str, objects: int = 3) -> list[Row]:
    return [Row(name, task, objects, options) for task in TASKS]


SUCCESS = [
    *of_each_task("ours, 3 objects"),
    *of_each_task("ours, 5 objects", objects=5),
    Row("ours, 10 objects", "crossing", 10, ("planner.horizon=60",)),
    *of_each_task("ours, in the paper's world", "env.robot=sawyer", *SEEN),
    *of_each_task("Algorithm 1, 3 objects", *PAPER, "env.segmentation=clusters", "criterion=published"),
    *of_each_task("script without a model, 3 objects", "planner=scripted"),
    *(row for seed in range(3) for row in of_each_task(f"quickstart, seed {seed}", MADE.format(seed))),
]
PLANNERS: dict[str, tuple[str, ...]] = {
    "ours": (),
    **{one.label: one.planners["paper"] for one in METHODS.values() if one.in_paper},
    "script": ("planner=scripted",),
    "heuristic": ("planner=heuristic",),
}
LAYOUTS = [
    row
    for (name, options), layout in product(PLANNERS.items(), range(3))
    for row in of_each_task(f"{name}, layout {layout}", f"layout={layout}", "criterion=published", *options)
    if (row.task, layout) != ("insertion", 1)  # which is layout 0
]

FEW = "{_target_:cavin_pyro.planning.additions.NearestObjects,of_all:2}"
HARD_PLANNERS = PLANNERS | {
    "ours, guidance": ("planner.add=[guidance]",),
    "ours, guidance, masks": ("planner.add=[guidance]", "env.segmentation=mask"),
    "ours, guidance, oracle f": (
        "planner.add=[guidance,{_target_:oracle.Oracle}]",
        "planner.drop=[failure_avoidance,perturbed_rollouts]",
    ),
    "ours, guidance, effects of two": (f"planner.add=[guidance,{FEW}]",),
}
HARD = [
    Row(name, task, objects, ("layout=hard", *SEEN, "env.ranges.clearance=0.1", *options))
    for name, options in HARD_PLANNERS.items()
    for task, objects in (("clearing", 10), ("insertion", 5), ("crossing", 9))
    if task == "clearing" or "of two" not in name
]


def generated(task: str, tiles: int) -> Row:
    options = ("layout=generated", f"generated.tiles={tiles}", "planner.add=[guidance]", "maximum_steps=120")
    return Row(f"generated, {tiles} tiles", task, 3, options)


FARTHER = [
    Row("8 objects", "crossing", 8, ("planner.horizon=60",)),
    Row("8 objects, effects of all", "clearing", 8, ("layout=1", "env.ranges.clearance=0.1")),
    Row("8 objects, effects of two", "clearing", 8, ("layout=1", "env.ranges.clearance=0.1", f"planner.add=[{FEW}]")),
    *(generated("crossing", tiles) for tiles in (6, 9, 12)),
    *(generated("insertion", tiles) for tiles in (5, 7)),
    *(generated("clearing", tiles) for tiles in (6, 9, 14)),
    Row("3 objects", "rearrange", 3, ("planner.horizon=3", "reward=dense")),
]
LEFT_OUT = {  # an addition, and the options without it
    "nothing": (),
    "one push per plan": ("pushes_per_plan=null",),
    "perturbed rollouts": ("planner.drop=[perturbed_rollouts]",),
    "failure avoidance": ("planner.drop=[failure_avoidance]",),
    "margin": ("margin=0",),
    "touchdown": ("planner.drop=[touchdown]",),
    "plans about the target": ("planner.drop=[nearest_objects]",),
    "first push": ("planner.drop=[first_push]",),
}
ADDITIONS = [
    Row(name, task, objects, options)
    for name, options in LEFT_OUT.items()
    for task, objects in (("clearing", 5), ("insertion", 3), ("crossing", 5))
]
TRAININGS = 3  # runs/pusht-0 and so on, by docs/how-to/push-t.md, pusht-normal-0 with prior=standard; runs/maze-0
PUSHT = {
    "75 ahead": ("env=pusht",),
    "25 ahead": ("env=pusht", "env.ahead=25", "env.maximum_steps=10"),
}
BOTH = ("75 ahead", "25 ahead")
DEPTH = {"75 ahead": "planner.horizon=15", "25 ahead": "planner.horizon=6"}
CASCADE = (*RECIPES["pusht"].plan.split(), "checkpoint=runs/pusht-{}/checkpoint.safetensors")
QUICK = "checkpoint=runs/quickstart/pusht-20-{}/train/checkpoint.safetensors"  # by quickstart env=pusht seed=0, 1, 2
ACTIONS = ("planner=mpc", "planner.additions=[]")
FLAT = (*ACTIONS, "pushes_per_plan=null", *CASCADE, "planner.add=[]")


def pusht(name: str, *options: str, tasks: Sequence[str] = ("75 ahead",)) -> list[Row]:
    return [Row(name, task, None, (*PUSHT[task], *options, DEPTH[task])) for task in tasks]


MAZE = ("env=maze", "planner.horizon=60", "checkpoint=runs/maze-{}/checkpoint.safetensors")
WORLDS = [
    *pusht("cascade", *CASCADE, tasks=BOTH),
    *pusht("quickstart", *CASCADE, QUICK, tasks=BOTH),
    *pusht("quickstart, 8,192 samples", *CASCADE, QUICK, "planner.samples=8192", tasks=BOTH),
    *pusht("cascade, no other effects", *CASCADE, "planner.add=[perturbed_rollouts]"),
    *pusht("cascade, N(0, I)", *CASCADE, "checkpoint=runs/pusht-normal-{}/checkpoint.safetensors"),
    *pusht("flat: actions", *FLAT, tasks=BOTH),
    *(Row("random actions", task, None, (*PUSHT[task], "planner=random")) for task in BOTH),
    Row("random actions", "maze", None, ("env=maze", "planner=random")),
    Row("cascade", "maze", None, (*MAZE, "planner.motion_horizon=first_segment", "planner.samples=4096")),
    Row("flat: actions", "maze", None, (*MAZE, *ACTIONS, "planner.samples=2048", "planner.optimizer=cem")),
]
TABLES = {"success": SUCCESS, "layouts": LAYOUTS, "hard": HARD, "farther": FARTHER}
TABLES |= {"additions": ADDITIONS, "worlds": WORLDS}
_runner: tuple[list[str], EpisodeRunner] | None = None  # one per process


def play(job: tuple[Row, int]) -> list[Record]:
    """One episode of a row: a record, or with the published rules two."""
    global _runner
    row, seed = job
    torch.set_num_threads(1)
    overrides = row.overrides(seed)
    config = compose("evaluate", *overrides)
    if _runner is None or _runner[0] != overrides:
        if _runner is not None:
            _runner[1].env.close()
        _runner = overrides, make_runner(config)
        Oracle.env = _runner[1].env
    found, given = episode_row(_runner[1].rollout(seed)), dict(option.split("=", 1) for option in row.options)
    shared = {
        **{"row": row.name, "task": row.task, "objects": row.objects, "seed": seed},
        "planner": given.get("planner", "cavin" if row.objects else "search"),
        "checkpoint": config.checkpoint or config.planner.default_checkpoint,
        **{name: found[name] for name in ("unsafe", "ineffective", "planning_ms")},
    }
    if row.objects is None:
        return [{**shared, **{name: found[name] for name in ("outcome", "steps")}}]
    shared |= {
        **{"layout": str(config.layout), "tiles": config.generated.tiles if config.layout == "generated" else None},
        "segmentation": given.get("env.segmentation", "mask"),
    }
    records = [{**shared, "rules": config.criterion, "outcome": found["outcome"], "steps": found["steps"]}]
    if config.criterion != "strict":
        records.append({**shared, "rules": "strict", **{key: found[f"strict_{key}"] for key in ("outcome", "steps")}})
    return records


def missing(rows: Sequence[Row], seeds: Sequence[int], known: Sequence[Record]) -> list[tuple[Row, int]]:
    """Episodes of these rows and seeds that no record has."""
    done = {(record["row"], record["task"], record["seed"]) for record in known}
    by_training = sorted(seeds, key=lambda seed: seed % TRAININGS)  # so that few models are loaded
    return [(row, seed) for row in rows for seed in by_training if (row.name, row.task, seed) not in done]


def add(
    path: Path,
    rows: Sequence[Row],
    seeds: Sequence[int],
    workers: int,
    about: Mapping[str, Record],
    schema: pyarrow.Schema = SCHEMA,
) -> None:
    """Play what a file does not have yet, and add it; `about`: further columns, by the name of the row."""
    records, now = read(path), commit()
    jobs = missing(rows, seeds, records)
    bar = progress_bar("playing", total=len(jobs), unit="episode")
    with bar, closing(run_jobs(play, jobs, workers)) as ended:
        for number, (_, found) in enumerate(ended, start=1):
            records += [{**record, **about.get(record["row"], {}), "commit": now} for record in found]
            bar.update()
            if number % WRITE_EVERY == 0 or number == len(jobs):
                write(path, records, schema)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("--seed", type=int, required=True, help="of the first scene")
    parser.add_argument("--episodes", type=int, default=200, help="of each row (%(default)s)")
    parser.add_argument("--rows", nargs="+", help="names of rows; all by default")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS, help="another folder than docs/results")
    arguments = parser.parse_args()
    rows = [row for row in TABLES[arguments.table] if arguments.rows is None or row.name in arguments.rows]
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    add(arguments.results / f"{arguments.table}.parquet", rows, seeds, arguments.workers, {})


if __name__ == "__main__":
    main()
