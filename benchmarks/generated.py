"""Success against difficulty: `python benchmarks/generated.py DIR [--task crossing] [--tiles 4 6] [--episodes 20]`.

One evaluation for each number of tiles and each kind of guidance, in a folder of its own under DIR, on scenes of its
own: those of t tiles have the seeds from `--seed` + 100 t on. A stopped run resumes. It ends with one table,
`generated.md`, and one picture, `generated.png`. Overrides of `evaluate` may follow, for example objects=5.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.comparison import compare
from cavin_pyro.evaluation.evaluation import evaluate
from cavin_pyro.evaluation.statistics import wilson
from cavin_pyro.storage.run_directory import check_same_run, write_config
from planning.extensions.guidance import GUIDANCE

COLORS = {"none": "#5A5A5A", "layout": "#0072B2"}
Cell = tuple[int, str]  # tiles, guidance


def run(folder: Path, arguments: argparse.Namespace, cell: Cell, overrides: list[str]) -> list[dict[str, Any]]:
    """The episodes of one cell."""
    tiles, guidance = cell
    config = compose(
        "evaluate",
        f"task={arguments.task}",
        "layout=generated",
        f"generated.tiles={tiles}",
        f"planner.guidance={guidance}",
        "maximum_steps=120",
        "workers=1",
        *overrides,
        f"episodes={arguments.episodes}",
        f"seed={arguments.seed + 100 * tiles}",
    )
    folder.mkdir(parents=True, exist_ok=True)
    check_same_run(folder, config, ignore=("episodes", "output", "workers"))
    write_config(folder, config)
    rows: list[dict[str, Any]] = evaluate(config, folder)
    return rows


def line(cell: Cell, rows: list[dict[str, Any]], others: list[dict[str, Any]] | None) -> str:
    """A row of the table: rates, how episodes ended, and the comparison with the other guidance on the same scenes."""
    ends = [row["outcome"] for row in rows]
    rate = wilson(ends.count("success"), len(ends))
    pushes = [row["steps"] for row in rows if row["outcome"] == "success"]
    cells = [
        *cell,
        f"{ends.count('success')} of {len(ends)}",
        f"{100 * rate['rate']:.0f} % ({100 * rate['low']:.1f} to {100 * rate['high']:.1f})",
        *(ends.count(name) for name in ("timeout", "violation", "fall")),
        f"{np.mean(pushes):.1f}" if pushes else "-",
        f"{sum(row['plans_reaching_goal'] for row in rows) / sum(row['plans'] for row in rows):.0%}",
    ]
    if others is not None:
        pair = compare(rows, others)
        cells.append(
            f"both {pair.both}, it alone {pair.one_alone}, none alone {pair.other_alone}, p = {pair.p_value:.2g}"
        )
    else:
        cells.append("")
    return f"| {' | '.join(map(str, cells))} |"


def table(results: dict[Cell, list[dict[str, Any]]]) -> str:
    """All cells in Markdown."""
    head = (
        "| tiles | guidance | success | rate (95 %) | out of time | violations | falls | pushes to the goal "
        "| plans that reach it | against none, same scenes |"
    )
    lines = [head, "|" + " --- |" * 10]
    for cell, rows in sorted(results.items(), key=lambda one: (one[0][0], GUIDANCE.index(one[0][1]))):
        tiles, guidance = cell
        lines.append(line(cell, rows, None if guidance == "none" else results.get((tiles, "none"))))
    return "\n".join(lines)


def picture(results: dict[Cell, list[dict[str, Any]]], task: str, path: Path) -> None:
    """Rates of success with their intervals over the number of tiles."""
    figure = Figure(figsize=(6.4, 3.8), dpi=150, layout="constrained")
    axes = figure.subplots()
    for shift, guidance in zip((-0.06, 0.06), GUIDANCE, strict=True):
        cells = sorted(tiles for tiles, kind in results if kind == guidance)
        if not cells:
            continue
        counts = [[row["outcome"] for row in results[tiles, guidance]] for tiles in cells]
        rates = [wilson(ends.count("success"), len(ends)) for ends in counts]
        middle, low, high = (100 * np.array([rate[name] for rate in rates]) for name in ("rate", "low", "high"))
        axes.errorbar(
            np.array(cells) + shift,
            middle,
            yerr=[middle - low, high - middle],
            label=f"planner.guidance={guidance}",
            color=COLORS[guidance],
            marker="o",
            capsize=3,
        )
    axes.set(xlabel="tiles", ylabel="success, % (95 % interval)", ylim=(-2, 102), title=f"{task}, layout=generated")
    axes.set_xticks(sorted({tiles for tiles, _ in results}))
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--task", default="crossing")
    parser.add_argument("--tiles", type=int, nargs="+", default=[4, 6, 9, 12])
    parser.add_argument("--guidance", nargs="+", choices=GUIDANCE, default=list(GUIDANCE))
    parser.add_argument("--episodes", type=int, default=20, help="of each number of tiles, at most 100")
    parser.add_argument("--seed", type=int, default=10000, help="scenes of t tiles have the seeds from this + 100 t on")
    arguments, overrides = parser.parse_known_args()
    results: dict[Cell, list[dict[str, Any]]] = {}
    for tiles in arguments.tiles:
        for guidance in arguments.guidance:
            folder = arguments.folder / f"{arguments.task}-{tiles}-{guidance}"
            results[tiles, guidance] = run(folder, arguments, (tiles, guidance), overrides)
            (arguments.folder / "generated.md").write_text(table(results) + "\n", encoding="utf-8")
            picture(results, arguments.task, arguments.folder / "generated.png")
    print(table(results))


if __name__ == "__main__":
    main()
