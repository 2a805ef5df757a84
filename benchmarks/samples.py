"""Samples against success: `python benchmarks/samples.py [--models checkpoints/reproduction]`.

Success against milliseconds per plan, for 64 to 8,192 samples, every method of the paper's figure and two planners for
each: the paper's and ours. Sparse reward, published criterion, depth-only segmentation; the scenes have the seeds from
73000 on and are the same for all. Without --models the planners take the checkpoints of their presets.

Every method, planner and number of samples is a folder of `evaluate` of its own in the output folder, so a killed run
goes on with the same command, and more --samples or --episodes join those that are finished. Writes `samples.md` and
`samples.png` there. Times are processor times of first plans, taken after the episodes, so that other work on the
machine disturbs them little.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from omegaconf import DictConfig

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.observed import observed_state
from cavin_pyro.evaluation.evaluation import Row, append, begin, missing_seeds, run_jobs, seeds_of
from cavin_pyro.evaluation.factory import make_runner
from cavin_pyro.evaluation.statistics import wilson
from cavin_pyro.reproduction.methods import METHODS, PAPER_METHODS
from cavin_pyro.reproduction.pipeline import SHARED
from cavin_pyro.storage.files import atomic_write, output_folder
from cavin_pyro.storage.progress import progress_bar
from cavin_pyro.storage.run_directory import check_same_run, write_config
from envs.randomness import planner_seed

SAMPLES = [64, 128, 256, 512, 1024, 2048, 4096, 8192]
FIRST_SCENE = 73_000  # docs/measurements/index.md
PLANNERS = {
    "paper": "planners as in the paper, a plan for 3 pushes",
    "ours": "with our additions, a plan for each push",
}
HALO = [withStroke(linewidth=2.0, foreground="white")]
Setting = tuple[str, str, int]  # method, planner, samples
Point = dict[str, Any]


def configurations(arguments: argparse.Namespace) -> Iterator[tuple[Setting, DictConfig]]:
    """The options of `evaluate` for every method, planner and number of samples."""
    shared = [f"task={arguments.task}", *SHARED, f"objects={arguments.objects}", f"seed={FIRST_SCENE}"]
    shared += [f"episodes={arguments.episodes}", f"workers={arguments.workers}"]
    for method in arguments.methods:
        for planner in arguments.planners:
            for samples in arguments.samples:
                folder = arguments.output / f"{method}-{planner}-{samples}"
                own = [*METHODS[method].planners[planner], f"planner.samples={samples}", f"output={folder}"]
                if arguments.models is not None:
                    own.append(f"checkpoint={arguments.models / f'{method}-{arguments.training_seed}.safetensors'}")
                yield (method, planner, samples), compose("evaluate", *shared, *own, *arguments.options)


def run(settings: Mapping[Setting, DictConfig], workers: int) -> dict[Setting, list[Row]]:
    """The episodes of all settings, one queue for all; those that are on disk are not run again."""
    with ExitStack() as held:
        folders = {setting: held.enter_context(output_folder(config.output)) for setting, config in settings.items()}
        return _run(settings, folders, workers)


def _run(
    settings: Mapping[Setting, DictConfig], folders: Mapping[Setting, Path], workers: int
) -> dict[Setting, list[Row]]:
    rows, jobs, owners = {}, [], []
    for setting, config in settings.items():
        check_same_run(folders[setting], config, ignore=("output", "episodes", "workers", "compare"))
        write_config(folders[setting], config)
        rows[setting] = begin(folders[setting])
        for seed in missing_seeds(seeds_of(config), rows[setting]):
            jobs.append((config, seed))
            owners.append(setting)
    with (
        closing(run_jobs(jobs, workers)) as finished,
        progress_bar("evaluating", total=len(jobs), initial=0, unit="episode") as bar,
    ):
        for number, row in finished:
            setting = owners[number]
            rows[setting][row["seed"]] = row
            append(folders[setting], row)
            bar.update()
    return {
        setting: [rows[setting][seed] for seed in range(FIRST_SCENE, FIRST_SCENE + config.episodes)]
        for setting, config in settings.items()
    }


def plan_milliseconds(config: DictConfig, scenes: int) -> float:
    """Processor time of a scene's first plan, median over the first `scenes` scenes of an evaluation."""
    runner, spent = make_runner(config), []
    try:
        for seed in range(config.seed, config.seed + scenes):
            observation, _ = runner.env.reset(seed=seed)
            state = observed_state(observation, runner.geometry)
            generator = torch.Generator().manual_seed(planner_seed(seed))
            began = time.process_time()
            runner.planner.plan(state, [generator])
            spent.append(1e3 * (time.process_time() - began))
    finally:
        runner.env.close()
    return float(np.median(spent))


def points(rows: Mapping[Setting, Sequence[Row]], milliseconds: Mapping[Setting, float]) -> list[Point]:
    """Of every setting: its rate of success by both criteria, with Wilson's interval, and the time of a plan."""
    found = []
    for setting, own in rows.items():
        method, planner, samples = setting
        point = {"method": method, "planner": planner, "samples": samples, "episodes": len(own)}
        for criterion, key in (("published", "outcome"), ("strict", "strict_outcome")):
            point[criterion] = wilson(sum(row[key] == "success" for row in own), len(own))
        point["milliseconds"] = milliseconds[setting]
        found.append(point)
    return found


def choices(found: Sequence[Point], criterion: str) -> list[Point]:
    """Settings that no other beats: none is as fast and succeeds more often. From the fastest to the best."""
    best, chosen = -1.0, []
    for point in sorted(found, key=lambda one: (one["milliseconds"], -one[criterion]["rate"])):
        if point[criterion]["rate"] > best:
            best = point[criterion]["rate"]
            chosen.append(point)
    return chosen


def table(found: Sequence[Point], arguments: argparse.Namespace) -> str:
    """Markdown. A star marks the settings to choose from."""
    chosen = {criterion: choices(found, criterion) for criterion in ("published", "strict")}
    last = FIRST_SCENE + arguments.episodes - 1
    lines = [
        "# Samples against success",
        "",
        f"{arguments.task}, sparse reward, {arguments.objects} objects, scenes {FIRST_SCENE} to {last}, "
        "objects told apart in the depth image alone.",
        "Success with Wilson's 95 % interval; time: processor time of the first plan, median of",
        f"{arguments.timed} scenes, {torch.get_num_threads()} thread(s). The paper's planners make a plan for 3",
        "pushes, ours one for each push.",
        "\\*: no other is as fast and succeeds more often.",
        "",
        "| method | planner | samples | CPU ms per plan | success, published | success, strict |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for one in found:
        rates = []
        for criterion, best in chosen.items():
            rate = one[criterion]
            text = f"{100 * rate['rate']:.1f} % ({100 * rate['low']:.1f} to {100 * rate['high']:.1f})"
            rates.append(text + " \\*" * (one in best))
        names = [METHODS[one["method"]].label, one["planner"], str(one["samples"]), f"{one['milliseconds']:.1f}"]
        lines.append("| " + " | ".join([*names, *rates]) + " |")
    return "\n".join([*lines, ""])


def draw(path: Path, found: Sequence[Point], title: str) -> None:
    """A column per planner, a row per criterion, with the best of the whole row for every time."""
    planners = [name for name in PLANNERS if any(one["planner"] == name for one in found)]
    figure = Figure(figsize=(max(6.8, 5.6 * len(planners)), 7.6), dpi=120, layout="constrained")
    panels = figure.subplots(2, len(planners), squeeze=False, sharex=True, sharey=True)
    for row, criterion in zip(panels, ("published", "strict"), strict=True):
        front = choices(found, criterion)
        for panel, planner in zip(row, planners, strict=True):
            draw_panel(panel, [one for one in found if one["planner"] == planner], front, criterion)
            panel.set_title(f"{PLANNERS[planner]}", fontsize=10)
        row[0].set_ylabel(f"success, %; criterion: {criterion}")
    times = [one["milliseconds"] for one in found]
    for panel in panels[-1]:
        panel.set_xlim(0.7 * min(times), 1.4 * max(times))
        panel.set_xlabel("processor milliseconds of a first plan (median)")
    shown = dict.fromkeys(one["method"] for one in found)
    handles = [Line2D([], [], color=METHODS[name].color, marker="o", label=METHODS[name].label) for name in shown]
    handles.append(Line2D([], [], color="black", linestyle=":", label="the best for the time"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9, frameon=False)
    legend = "Numbers: samples (1k = 1,024). Rings: no setting is as fast and succeeds more often"
    figure.suptitle(f"{title}\n{legend}", fontsize=10)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, facecolor="white", metadata={"Software": None})


def draw_panel(panel: Axes, own: Sequence[Point], front: Sequence[Point], criterion: str) -> None:
    """Lines of methods with whiskers and numbers of samples, over the front."""
    panel.set_xscale("log")
    steps = [(one["milliseconds"], 100 * one[criterion]["rate"]) for one in front]
    panel.plot(*zip(*steps, strict=True), color="black", linestyle=":", linewidth=1, drawstyle="steps-post", zorder=1)
    for name, method in METHODS.items():
        line = [one for one in own if one["method"] == name]
        if not line:
            continue
        times = [one["milliseconds"] for one in line]
        rates = [100 * one[criterion]["rate"] for one in line]
        low, high = ([100 * one[criterion][end] for one in line] for end in ("low", "high"))
        whiskers = [np.maximum(0.0, np.subtract(rates, low)), np.maximum(0.0, np.subtract(high, rates))]
        style: dict[str, Any] = {"marker": "o", "markersize": 3.5, "linewidth": 1.3, "elinewidth": 0.5}
        panel.errorbar(times, rates, whiskers, color=method.color, **style)
        for one, spent, rate in zip(line, times, rates, strict=True):
            text = f"{one['samples'] // 1024}k" if one["samples"] % 1024 == 0 else str(one["samples"])
            place: dict[str, Any] = {"xytext": (0, 5), "textcoords": "offset points", "ha": "center"}
            panel.annotate(text, (spent, rate), fontsize=7, color=method.color, path_effects=HALO, **place)
            if one in front:
                panel.plot(
                    spent, rate, "o", markersize=10, fillstyle="none", color="black", markeredgewidth=1, zorder=5
                )
    panel.xaxis.set_major_formatter("{x:g}")
    panel.set_ylim(-3, 106)
    panel.grid(color="#E4E4E4", linewidth=0.6)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", type=Path, help="folder of trained models, METHOD-SEED.safetensors")
    parser.add_argument("--training-seed", type=int, default=0, help="of the models in --models")
    parser.add_argument("--task", default="crossing")
    parser.add_argument("--objects", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=100, help="scenes, the same for every setting")
    parser.add_argument("--timed", type=int, default=8, help="scenes whose first plans are timed")
    parser.add_argument("--samples", type=int, nargs="+", default=SAMPLES)
    parser.add_argument("--methods", nargs="+", default=PAPER_METHODS, choices=METHODS)
    parser.add_argument("--planners", nargs="+", default=list(PLANNERS), choices=PLANNERS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--output", type=Path, default=Path("runs/samples"))
    parser.add_argument("options", nargs="*", help="further options of `evaluate`, such as maximum_steps=30")
    arguments = parser.parse_args()
    if min(arguments.episodes, arguments.workers, arguments.timed) < 1:
        parser.error("--episodes, --workers and --timed must be at least 1")
    try:
        settings = dict(configurations(arguments))
        rows = run(settings, arguments.workers)
        found = points(rows, {one: plan_milliseconds(config, arguments.timed) for one, config in settings.items()})
    except UserError as error:
        parser.exit(2, f"error: {error}\n")
    with atomic_write(arguments.output / "samples.md") as temporary:
        temporary.write_text(table(found, arguments), encoding="utf-8")
    draw(arguments.output / "samples.png", found, f"{arguments.task}, sparse reward, {arguments.objects} objects")
    print(arguments.output / "samples.md", arguments.output / "samples.png", sep="\n")


if __name__ == "__main__":
    main()
