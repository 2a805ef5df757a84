"""Stacked bars of why episodes fail."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.patches import Patch

from cavin_pyro.reproduction.episodes.failures import FAILURES
from cavin_pyro.reproduction.figure import DOTS_PER_INCH, TITLES
from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.storage.files import atomic_write

# What ended an episode differs in colour; of timeouts, how often a plan had expected success, in lightness.
COLORS = {"violation": "#D55E00", "fall": "#CC79A7", "never": "#08306B", "seldom": "#4292C6", "promised": "#C6DBEF"}


def draw_failures(path: Path, counted: Sequence[Mapping[str, Any]], *, planner: str, criterion: str) -> None:
    """One bar per task and method, as high as its share of failures.

    Args:
        counted: as in `failures.failures`.
    """
    own = [one for one in counted if (one["planner"], one["criterion"]) == (planner, criterion)]
    tasks = list(dict.fromkeys(one["task"] for one in own))
    figure = Figure(figsize=(max(6.0, 3.2 * len(tasks) + 0.6), 4.0), dpi=DOTS_PER_INCH, layout="constrained")
    panels = figure.subplots(1, len(tasks), squeeze=False, sharey=True)[0]
    for panel, task in zip(panels, tasks, strict=True):
        of_task = {one["method"]: one for one in own if one["task"] == task}
        shown = [name for name in METHODS if name in of_task]
        for place, name in enumerate(shown):
            one, bottom = of_task[name], 0.0
            for kind, color in COLORS.items():
                share = 100 * one[kind] / one["episodes"]
                panel.bar(place, share, 0.7, bottom=bottom, color=color, edgecolor="white", linewidth=0.5)
                bottom += share
            label = f"{bottom:.0f} %\nn={one['episodes']}"
            panel.annotate(label, (place, bottom), (0, 2), textcoords="offset points", fontsize=7, ha="center")
        panel.set_xticks(range(len(shown)), [METHODS[name].label for name in shown], fontsize=8)
        panel.set_title(task, fontsize=10)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylim(0, 112)  # room for the numbers
    panels[0].set_yticks(range(0, 101, 20))
    panels[0].tick_params(axis="y", labelsize=8)
    panels[0].set_ylabel("failed episodes, %", fontsize=9)
    handles = [Patch(color=COLORS[kind], label=FAILURES[kind]) for kind in COLORS]
    columns = 2 if len(tasks) == 1 else 3
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=8, frameon=False)
    figure.suptitle(f"why episodes fail: {TITLES.get(planner, planner)}; criterion: {criterion}", fontsize=10)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, facecolor="white", metadata={"Software": None})
