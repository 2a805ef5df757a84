"""Success against the minutes from an empty folder: `python benchmarks/competence.py --seed FIRST`.

For each world and size it runs what `python -m cavin_pyro.quickstart minutes=SIZE` runs up to the training, each
command in a process of its own, whose minutes count, and then new episodes of each task, which do not. The size
`shipped` is docs/how-to/collect-and-train.md, the paper's networks on 100,000 pushes. On the tabletop the paper's
planner meets the same scenes, by the published rules; how its episodes end by the strict ones is also kept. Rerun to
resume: an interrupted command begins again, and what is in docs/results/competence.parquet is not run again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pyarrow
from episodes import PAPER, SCHEMA, Row, add
from matplotlib.figure import Figure
from records import ROOT, Record, read
from tables import groups

from cavin_pyro.config.composition import compose
from cavin_pyro.config.recipes import steps_of
from cavin_pyro.evaluation.statistics import wilson
from cavin_pyro.visualization.training import DOTS_PER_INCH, save_figure

WORLDS = {"tabletop": [], "pusht": ["env=pusht"]}
SHIPPED = {
    "collect": "transitions=100000 workers=2 seed={seed} output={home}/data",
    "pretrain": "data={home}/data seed={seed} output={home}/pretrain",
    "train": "model=cascaded guide=cascaded prior=conditional pointnet={home}/pretrain/pointnet.safetensors "
    "trainer.steps=64000 trainer.batch_size=256 trainer.learning_rate=1e-3 trainer.schedule=cosine "
    "trainer.batches=bucketed data={home}/data seed={seed} output={home}/train",
}
OF_QUICKSTART = ("task=", "seed=", "episodes=", "workers=", "output=")  # options of its evaluations
PLANNERS = {"cavin": ("ours", "-"), "search": ("ours", "-"), "paper": ("Algorithm 1, published rules", "--")}
COLORS = {"clearing": "#0072B2", "insertion": "#D55E00", "crossing": "#009E73", "75 ahead": "#0072B2"}
TITLES = {"tabletop": "tabletop, 3 objects", "pusht": "Push-T"}
TICKS = (1, 2, 3, 5, 10, 20, 30, 50, 100)
COLUMNS = [  # beside those of all episodes
    *(pyarrow.field(name, pyarrow.string()) for name in ("world", "size")),
    pyarrow.field("training", pyarrow.int64()),
    *(pyarrow.field(name, pyarrow.float32()) for name in ("collect_minutes", "train_minutes")),
]


def commands(world: str, size: str, seed: int, home: Path) -> tuple[dict[str, list[str]], list[list[str]]]:
    """Options of the commands that make a checkpoint, and of the evaluations of it."""
    minutes = [] if size == "shipped" else [f"minutes={size}"]
    steps = list(steps_of(compose("quickstart", *WORLDS[world], *minutes, f"seed={seed}"), home))
    making = {step.command: step.options for step in steps if step.command in ("collect", "train")}
    if not minutes:
        making = {name: [one.format(home=home, seed=seed) for one in text.split()] for name, text in SHIPPED.items()}
    return making, [step.options for step in steps if step.command == "evaluate"]


def spent(making: Mapping[str, list[str]], home: Path) -> dict[str, float]:
    """Minutes of each command, which is run once."""
    home.mkdir(parents=True, exist_ok=True)
    kept = home / "minutes.json"
    minutes: dict[str, float] = json.loads(kept.read_text()) if kept.exists() else {}
    for command in [command for command in making if command not in minutes]:
        options, threads = making[command], {"OMP_NUM_THREADS": "1" if command == "collect" else "2"}
        shutil.rmtree(options[-1].removeprefix("output="), ignore_errors=True)  # of an interrupted one
        line, began = [sys.executable, "-m", f"cavin_pyro.{command}", *options], time.perf_counter()
        subprocess.run(line, check=True, env={**os.environ, **threads})
        minutes[command] = (time.perf_counter() - began) / 60
        kept.write_text(json.dumps(minutes))
    return minutes


def rows_of(name: str, evaluations: Sequence[list[str]]) -> list[Row]:
    """Each task with our planner, and on the tabletop, whose evaluations name it, with the paper's."""
    rows = []
    for evaluation in evaluations:
        options = tuple(option for option in evaluation if not option.startswith(OF_QUICKSTART))
        tasks = [option[5:] for option in evaluation if option.startswith("task=")]
        rows += [Row(f"{name}, ours", task, 3, options) for task in tasks]
        rows += [Row(f"{name}, paper", task, 3, (*PAPER, "criterion=published", *options)) for task in tasks]
        rows += [] if tasks else [Row(f"{name}, ours", "75 ahead", None, options)]
    return rows


def draw(path: Path, records: Sequence[Record]) -> None:
    """A panel per world; a line per task and planner, a lone star for the shipped recipe."""
    worlds = groups(records, "world")
    figure = Figure(figsize=(0.6 + 4.2 * len(worlds), 4.0), dpi=DOTS_PER_INCH, layout="constrained")
    panels = figure.subplots(1, len(worlds), squeeze=False, sharey=True)[0]
    for panel, ((world,), found) in zip(panels, worlds.items(), strict=True):
        drawn = [row for row in found if row["rules"] != "strict" or row["planner"] != "paper"]
        for place, ((task, planner), of_line) in enumerate(groups(drawn, "task", "planner").items()):
            label, style = PLANNERS[planner]
            line = []
            for (size,), rows in groups(of_line, "size").items():
                share = wilson(sum(row["outcome"] == "success" for row in rows), len(rows))
                y, low, high = (100 * share[name] for name in ("rate", "low", "high"))
                wall = statistics.mean(row["collect_minutes"] + row["train_minutes"] for row in rows)
                x = wall * 1.015**place  # so that whiskers do not lie on one another
                marker = "*" if size == "shipped" else "o"
                panel.errorbar(x, y, [[y - low], [high - y]], color=COLORS[task], marker=marker, capsize=2)
                line += [] if size == "shipped" else [(x, y)]
            panel.plot(*np.reshape(sorted(line), (-1, 2)).T, style, color=COLORS[task], label=f"{task}, {label}")
        panel.set_xscale("log")
        span = panel.get_xlim()  # which ticks widen
        panel.set_xticks(TICKS, map(str, TICKS))
        panel.set_xticks([], minor=True)
        panel.set(title=TITLES[world], xlabel="minutes from an empty folder", xlim=span, ylim=(0, 104))
        panel.grid(color="#DDDDDD", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(frameon=False, fontsize=8, loc="lower right")
    panels[0].set_ylabel("success, %")
    path.parent.mkdir(parents=True, exist_ok=True)
    save_figure(path, figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=10000, help="of the first scene (%(default)s)")
    parser.add_argument("--episodes", type=int, default=100, help="of each task, planner and training (%(default)s)")
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=WORLDS)
    parser.add_argument("--sizes", nargs="*", default=("3", "5", "10", "20"), help="minutes, or shipped; none: draw")
    parser.add_argument("--trainings", type=int, nargs="+", default=[0], help="seeds of data and training")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--runs", type=Path, default=Path("runs/competence"))
    parser.add_argument("--output", type=Path, default=ROOT / "docs", help="another folder than docs")
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    path, schema = arguments.output / "results" / "competence.parquet", pyarrow.schema([*SCHEMA, *COLUMNS])
    for world, training, size in product(arguments.worlds, arguments.trainings, arguments.sizes):
        if (world, size) == ("pusht", "shipped"):
            continue
        name = f"{world}-{size}-{training}"
        making, evaluations = commands(world, size, training, arguments.runs / name)
        minutes = spent(making, arguments.runs / name)
        rows, collecting = rows_of(name, evaluations), minutes.pop("collect")
        about: Record = {"world": world, "size": size, "training": training}
        about |= {"collect_minutes": collecting, "train_minutes": sum(minutes.values())}
        add(path, rows, seeds, arguments.workers, {row.name: about for row in rows}, schema)
    draw(arguments.output / "pictures" / "competence.png", read(path))


if __name__ == "__main__":
    main()
