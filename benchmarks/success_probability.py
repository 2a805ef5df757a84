"""The probability of success that plans are given: its episodes, its fit and its calibration.

    python benchmarks/success_probability.py collect DIR --seed 10000 [--share 0.5]
    python benchmarks/success_probability.py fit FILE FOLDER ... [--half first] [--keep FILE]
    python benchmarks/success_probability.py report FILE FOLDER ... [--half second] [--picture PNG]

`collect` evaluates the shipped planners in every family of scenes, each in a folder of its own under DIR; a stopped run
resumes. `fit` writes a regression for each planner in any folders of `python -m cavin_pyro.evaluate`, also of your own;
`plan` and `evaluate` read it with success_probability=FILE. `report` says how well a fit predicts other episodes: of
other folders, or with `--half`, by seed, of the half of each folder that the fit has not seen.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.evaluation import evaluate
from cavin_pyro.evaluation.success.calibration import Calibration, calibration
from cavin_pyro.evaluation.success.configuration import planner_mismatch
from cavin_pyro.evaluation.success.fit import RIDGE, Evaluated, by_planner, fit, read_evaluation, write_regressions
from cavin_pyro.evaluation.success.predictors import plans_of
from cavin_pyro.evaluation.success.probability import Regression, read_regressions
from cavin_pyro.evaluation.success.sentences import bounds
from cavin_pyro.storage.provenance import provenance
from cavin_pyro.storage.run_directory import check_same_run, write_config

Lines = list[tuple[list[float], bool]]  # of each episode, the predictions of its plans and whether it succeeded
COLUMNS = (
    *("episodes", "succeeded", "predicted", "calibration error", "debiased", "bins"),
    *("Brier score", "base rate's", "skill"),
)
STYLES = (("o", "#000000"), ("s", "#0072B2"), ("^", "#D55E00"), ("v", "#009E73"), ("D", "#CC79A7"))
HORIZON = 30  # pushes, by default
HALVES = ("all", "first", "second")
GENERATED = ("layout=generated", "maximum_steps=120")
GUIDED = ("planner.guidance=layout",)
PAPER = ("planner=paper",)
REARRANGE = ("task=rearrange", "checkpoint=contact", "planner.horizon=3", "reward=dense")


class Cell(NamedTuple):
    """Scenes of one kind for one planner."""

    family: str
    planner: str
    options: tuple[str, ...]
    episodes: int


def cells() -> dict[str, Cell]:
    """All cells by the names of their folders. A cell's place in the table fixes its seeds."""
    found: dict[str, Cell] = {}
    for task, three, five in (("crossing", 8, 10), ("insertion", 5, 8), ("clearing", 4, 4)):
        for objects, count in ((3, three), (5, five)):
            options: tuple[str, ...] = (f"task={task}", f"objects={objects}")
            found[f"{task}-{objects}"] = Cell("paper's tasks", "default", options, count)
    kinds = {"bridge": "crossing", "slot": "insertion", "region": "clearing"}
    plain = (("bridge", ((4, 3), (6, 6), (9, 5), (12, 2))), ("slot", ((5, 4), (8, 6))), ("region", ((9, 3),)))
    guided = (
        ("bridge", ((4, 4), (6, 8), (9, 12), (12, 10))),
        ("slot", ((5, 6), (8, 8))),
        ("region", ((4, 2), (9, 3), (14, 3))),
    )
    for suffix, planner, more, table in (("", "default", (), plain), ("-guided", "guided", GUIDED, guided)):
        for kind, sizes in table:
            for tiles, count in sizes:
                options = (f"task={kinds[kind]}", f"generated.tiles={tiles}", *GENERATED, *more)
                found[f"{kind}-{tiles}{suffix}"] = Cell(f"{kind}s", planner, options, count)
    found["crossing-5-guided"] = Cell("paper's tasks", "guided", ("task=crossing", "objects=5", *GUIDED), 6)
    for task, three, five in (("crossing", 16, 14), ("insertion", 10, 10), ("clearing", 6, 8)):
        for objects, count in ((3, three), (5, five)):
            options = (f"task={task}", f"objects={objects}", *PAPER)
            found[f"paper-{task}-{objects}"] = Cell("paper's tasks, planner=paper", "paper", options, count)
    found["rearrange-3"] = Cell("rearranging", "rearrange", REARRANGE, 16)
    return found


CELLS = cells()


def collect(home: Path, seed: int, share: float) -> None:
    """Evaluate every cell; its scenes have the seeds from `seed` + 100 times its number on."""
    for number, (name, cell) in enumerate(CELLS.items()):
        count = max(1, round(share * cell.episodes))
        config = compose("evaluate", *cell.options, "workers=1", f"episodes={count}", f"seed={seed + 100 * number}")
        folder = home / name
        folder.mkdir(parents=True, exist_ok=True)
        check_same_run(folder, config, ignore=("episodes", "output", "workers", "success_probability"))
        write_config(folder, config)
        rows = evaluate(config, folder)
        won = sum(row["outcome"] == "success" for row in rows)
        print(f"{name}: {won} of {len(rows)}, {sum(row['plans'] for row in rows)} plans", flush=True)


def read(folder: Path, half: str) -> Evaluated:
    """An evaluation, or half of it: the episodes of lower seeds (`first`) or of higher ones (`second`)."""
    one = read_evaluation(folder)
    rows = sorted(one.rows, key=lambda row: int(row["seed"]))
    middle = len(rows) // 2
    return one._replace(rows={"all": rows, "first": rows[:middle], "second": rows[middle:]}[half])


def planner_of(folder: Path, one: Evaluated) -> str:
    """The name of a planner, for people: of a cell, or by its guidance and horizon."""
    if folder.name in CELLS:
        return CELLS[folder.name].planner
    options = one.situation.planner
    name = "default" if options.get("planner.guidance", "none") == "none" else "guided"
    horizon = options.get("planner.horizon", HORIZON)
    return name if horizon == HORIZON else f"{name}, horizon {horizon}"


def fit_all(path: Path, folders: Sequence[Path], ridge: float, half: str, keep: Path | None) -> None:
    """Fit a regression for each planner, and write them, before those of the file `keep` with other checkpoints."""
    evaluations = [read(folder, half) for folder in folders]
    names = {id(one): planner_of(folder, one) for one, folder in zip(evaluations, folders, strict=True)}
    regressions = [fit(group, names[id(group[0])], ridge=ridge) for group in by_planner(evaluations)]
    seeds = sorted(row["seed"] for one in evaluations for row in one.rows)
    command = f"python benchmarks/success_probability.py {' '.join(sys.argv[1:])}"
    about = {"provenance": {**provenance(), "command": command}, "seeds": [seeds[0], seeds[-1]], "ridge": ridge}
    fitted = {one.checkpoint for one in regressions}
    kept = [one for one in read_regressions(keep) if one.checkpoint not in fitted] if keep else []
    write_regressions(path, [*regressions, *kept], about)
    for one in regressions:
        print(f"{one.name}: {one.successes} of {one.episodes} episodes succeeded, {one.plans} plans")
        for name, slope in one.slopes.items():
            print(f"  {slope:9.3f} per unit of: {name}")


def predictions(regressions: Sequence[Regression], one: Evaluated) -> Lines:
    """Predictions and outcomes of an evaluation's episodes; none if its planner was not fitted."""
    planner, checkpoint = one.situation.planner, one.situation.checkpoint
    fitting = [
        regression
        for regression in regressions
        if regression.checkpoint == checkpoint and not planner_mismatch(regression.planner, planner)
    ]
    found: Lines = []
    for row in one.rows if fitting else ():
        plans = plans_of(row["success_predictors"])
        told = [fitting[0](plans[: number + 1]) for number in range(len(plans))]
        known = [value for value in told if value is not None]
        if len(known) == len(plans):
            found.append((known, row["outcome"] == "success"))
    return found


def compared(lines: Lines) -> Calibration:
    """The calibration of these episodes."""
    return calibration([told for told, _ in lines], [ended for _, ended in lines])


def report(path: Path, folders: Sequence[Path], picture: Path | None, half: str) -> None:
    """Print the calibration overall, by planner, by family and by cell, and draw it."""
    regressions = read_regressions(path)
    evaluations = {folder: read(folder, half) for folder in folders}
    lines = {folder: predictions(regressions, one) for folder, one in evaluations.items()}
    groups: dict[str, Lines] = {"all": [line for some in lines.values() for line in some]}
    for folder, some in lines.items():
        cell = CELLS.get(folder.name)
        for name in (f"planner: {planner_of(folder, evaluations[folder])}", cell.family if cell else folder.name):
            groups.setdefault(name, []).extend(some)
    print(f"| | {' | '.join(COLUMNS)} |\n|{' --- |' * (1 + len(COLUMNS))}")
    for name, some in sorted(groups.items(), key=lambda one: (one[0] != "all", not one[0].startswith("planner"))):
        if some:
            print(row_of(name, compared(some)))
    if picture is not None and groups["all"]:
        drawn = [name for name, some in groups.items() if some and (name == "all" or name.startswith("planner"))]
        draw(picture, {name: compared(groups[name]) for name in drawn})


def row_of(name: str, found: Calibration) -> str:
    """A row of the table in Markdown."""
    rate = found.successes / found.episodes
    skill = f"{found.skill:.2f}" if found.base > 0.0 else "-"
    parts = (
        *(name, found.episodes, f"{100 * rate:.1f} %", f"{100 * (rate + found.bias.value):.1f} %"),
        *(bounds(found.error), bounds(found.debiased), len(found.weight)),
        *(f"{found.brier:.3f}", f"{found.base:.3f}", skill),
    )
    return f"| {' | '.join(map(str, parts))} |"


def draw(path: Path, found: dict[str, Calibration]) -> None:
    """The reliability diagram: the frequency of success over the mean prediction, for all and for each planner."""
    figure = Figure(figsize=(5.2, 6.4), dpi=150, layout="constrained")  # inches
    axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color="#BBBBBB", linewidth=1, zorder=0)
    for (name, one), (marker, color) in zip(found.items(), cycle(STYLES), strict=False):
        whole = name == "all"
        axes.scatter(
            100 * one.predicted,
            100 * one.observed,
            s=600 * one.weight / max(1.0, len(found) / 2),
            marker=marker,
            color=color,
            alpha=1.0 if whole else 0.6,
            clip_on=False,
            label=f"{name}, {one.episodes} episodes: {bounds(one.error)}",
            zorder=3 if whole else 2,
        )
        axes.plot(100 * one.predicted, 100 * one.observed, color=color, linewidth=1.5 if whole else 0.7, alpha=0.8)
    axes.set(xlabel="predicted success of a plan's episode, %", ylabel="succeeded, %", xlim=(-3, 103), ylim=(-3, 103))
    axes.set_aspect("equal")
    title = "calibration error (95 %)"
    legend = figure.legend(frameon=False, fontsize=8, loc="outside lower center", title=title, title_fontsize=8)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_sizes(np.array([25.0]))  # type: ignore[attr-defined]
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("collect", help="evaluate the shipped planners in every family of scenes")
    one.add_argument("folder", type=Path)
    one.add_argument("--seed", type=int, default=10000, help="of the first scene; 100 seeds for each cell")
    one.add_argument("--share", type=float, default=1.0, help="of the episodes of a full collection")
    for name, about in (("fit", "fit a regression for each planner"), ("report", "compare predictions with outcomes")):
        one = commands.add_parser(name, help=about)
        one.add_argument("file", type=Path, help="of the fit, .json")
        one.add_argument("folders", type=Path, nargs="+", help="of python -m cavin_pyro.evaluate")
        one.add_argument("--half", choices=HALVES, default="all", help="of the episodes of each folder, by seed")
        if name == "fit":
            one.add_argument("--ridge", type=float, default=RIDGE, help="inverse variance of the slopes' prior")
            one.add_argument("--keep", type=Path, help="a fit, whose regressions for other checkpoints stay")
        else:
            one.add_argument("--picture", type=Path, help="of the reliability diagram, .png")
    given = parser.parse_args()
    try:
        if given.command == "collect":
            collect(given.folder, given.seed, given.share)
        elif given.command == "fit":
            fit_all(given.file, given.folders, given.ridge, given.half, given.keep)
        else:
            report(given.file, given.folders, given.picture, given.half)
    except UserError as error:
        parser.exit(2, f"{error}\n")


if __name__ == "__main__":
    main()
