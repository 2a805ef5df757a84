"""Time and memory against size: `python benchmarks/growth.py [--quick] [--panels NAME ...]`.

What a plan (shipped checkpoint, crossing), a step of training (256 windows) and a collected push cost on one thread,
with more objects, samples per plan, pushes per plan, and transitions of Push-T to train on. Each point is a command in
a process of its own: times are those that it writes, without its first, memory is the most that was resident. Points
replace those of docs/results/growth.parquet, from which the picture is drawn.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from records import ROOT, Record, commit, read, write

from cavin_pyro.config.recipes import TABLETOP, WORLDS
from cavin_pyro.data.dataset import iterate_shards, shard_path
from cavin_pyro.visualization.training import DOTS_PER_INCH, save_figure

SIZES = {  # and with --quick
    "objects": ([1, 3, 5, 10], [2]),
    "samples": ([256, 1024, 4096, 16_384, 65_536], [32]),
    "horizon": ([30, 60, 120, 240], [3]),
    "data": ([10_000, 100_000, 1_000_000], [2_000]),
}
OPTIONS = {"objects": "objects", "samples": "planner.samples", "horizon": "planner.horizon"}
TITLES = {"samples": "samples per plan", "horizon": "pushes per plan", "data": "transitions of Push-T"}
COLORS = {"plan": "#0072B2", "training step": "#D55E00", "collected push": "#009E73"}
ROWS = {"median_ms": "milliseconds", "peak_mb": "resident memory, MB"}
# A small process runs each: Linux counts the memory of what starts a process as its own. [2]: ru_maxrss.
PROBE = (
    "import sys, subprocess as s, resource as r; s.check_call(sys.argv[1:]); print(r.getrusage(r.RUSAGE_CHILDREN)[2])"
)
Cost = tuple[str, list[float], float]  # of a unit: its times in milliseconds, and MB


def peak(command: str, *options: str) -> float:
    """Run a command on one thread; the most memory that it had resident, MB."""
    line = [sys.executable, "-c", PROBE, sys.executable, "-m", f"cavin_pyro.{command}", *options]
    said = subprocess.check_output(line, env={**os.environ, "OMP_NUM_THREADS": "1"}, text=True)
    return int(said.split()[-1]) / (2**20 if sys.platform == "darwin" else 2**10)


def plans(folder: Path, panel: str, size: int, quick: bool) -> Cost:
    """16 plans or more: the first pushes of some episodes."""
    episodes = ["episodes=1", "planner.samples=32", "planner.horizon=3"] if quick else ["episodes=4"]
    few = ["task=crossing", "maximum_steps=4", "seed=10000", "workers=1", *episodes, f"{OPTIONS[panel]}={size}"]
    memory = peak("evaluate", *few, f"output={folder}")
    rows = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    return "plan", [value for row in rows for value in row["planning_ms"]][1:], memory


def steps(folder: Path, data: Path, recipe: str, quick: bool) -> Cost:
    """Steps of a recipe of `quickstart`, ten by ten."""
    few = [f"trainer.steps={20 if quick else 110}", "trainer.validate_every=10", "trainer.validation_windows=256"]
    memory = peak("train", *recipe.split(), *few, f"data={data}", f"output={folder}")
    with open(folder / "metrics.csv", encoding="utf-8") as file:
        rates = [float(row["windows_per_second"]) for row in csv.DictReader(file)]
    return "training step", [1e3 * 256 / rate for rate in rates[1:]], memory


def pushes(folder: Path, objects: int, quick: bool) -> Cost:
    """Pushes of the heuristic with so many objects, shard by shard."""
    some = [f"minimum_objects={objects}", f"maximum_objects={objects}", f"transitions={300 if quick else 1500}"]
    memory = peak("collect", *some, "episodes_per_shard=2", "workers=1", f"output={folder}")
    counts = [int(arrays["length"].sum()) for _, arrays in iterate_shards(folder, ["length"])]
    ends = [shard_path(folder, number).stat().st_mtime for number in range(len(counts))]
    times = [1e3 * (end - begin) / count for (begin, end), count in zip(pairwise(ends), counts[1:], strict=True)]
    return "collected push", times, memory


def measured(panel: str, size: int, folder: Path, quick: bool) -> Iterator[Cost]:
    """What is measured at a size; `folder` keeps the data of Push-T, which grow."""
    own, recipe = folder / f"{panel}-{size}", WORLDS["pusht"]
    if panel == "data":
        peak("collect", "env=pusht", *recipe.collect.split(), f"transitions={size}", f"output={folder / 'pusht'}")
        yield steps(own, folder / "pusht", recipe.train, quick)
        return
    yield plans(own / "plans", panel, size, quick)
    if panel == "objects":
        yield pushes(own / "pushes", size, quick)
        yield steps(own / "train", own / "pushes", f"{TABLETOP.train} model.maximum_objects={max(5, size)}", quick)


def draw(path: Path, records: Sequence[Record]) -> None:
    """A column per panel, times above memory."""
    names = [name for name in SIZES if any(row["panel"] == name for row in records)]
    figure = Figure(figsize=(9.0, 4.8), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.subplots(len(ROWS), len(names), squeeze=False, sharex="col", sharey="row")
    for column, name in enumerate(names):
        rows = sorted((row for row in records if row["panel"] == name), key=itemgetter("size"))
        ticks = list(dict.fromkeys(row["size"] for row in rows))
        for panel, value in zip(axes[:, column], ROWS, strict=True):
            for unit, color in COLORS.items():
                points = [(row["size"], row[value]) for row in rows if row["unit"] == unit]
                panel.plot(*np.reshape(points, (-1, 2)).T, "o-", color=color, markersize=4, label=unit)
            panel.set_yscale("log" if value == "median_ms" else "linear")
            panel.set_xscale("linear" if name == "objects" else "log")
            panel.xaxis.set_minor_locator(NullLocator())
            panel.set_xticks(ticks, [f"{tick:,}" for tick in ticks], rotation=30)
            panel.yaxis.set_major_formatter("{x:g}")
            panel.grid(color="#DDDDDD", linewidth=0.6)
            panel.spines[["top", "right"]].set_visible(False)
            panel.tick_params(labelsize=8)
        panel.set_xlabel(TITLES.get(name, name))
    for label, panel in zip(ROWS.values(), axes[:, 0], strict=True):
        panel.set_ylabel(label)
    axes[-1][0].set_ylim(bottom=0)
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=len(COLORS), frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_figure(path, figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one small point of each panel, to see that it runs")
    parser.add_argument("--panels", nargs="*", default=list(SIZES), choices=SIZES, help="none: only draw")
    parser.add_argument("--output", type=Path, default=ROOT / "docs", help="another folder than docs")
    arguments = parser.parse_args()
    path, now = arguments.output / "results" / "growth.parquet", commit()
    records = {(row["panel"], row["size"], row["unit"]): row for row in read(path)}
    with TemporaryDirectory() as folder:
        for panel in arguments.panels:
            for size in SIZES[panel][arguments.quick]:
                for unit, times, memory in measured(panel, size, Path(folder), arguments.quick):
                    spent = {"median_ms": median(times), "fastest_ms": min(times), "repetitions": len(times)}
                    found = {"panel": panel, "size": size, "unit": unit, **spent, "peak_mb": memory, "commit": now}
                    records[panel, size, unit] = found
                    write(path, [*records.values()])
                    print(found, flush=True)
    draw(arguments.output / "pictures" / "growth.png", [*records.values()])


if __name__ == "__main__":
    main()
