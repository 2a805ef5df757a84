"""The paper's figure: success with dense and sparse rewards, and against the number of objects."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cavin_pyro.reproduction.methods import METHODS, Method
from cavin_pyro.reproduction.sizes import REWARDS, TOP_ROW_OBJECTS
from cavin_pyro.visualization.training import DOTS_PER_INCH, save_figure

GROUP_WIDTH = 0.8  # of the bars of all methods side by side
DODGE = 0.06  # of lines whose whiskers would lie on one another, in objects
TITLES = {"paper": "planners as in the paper", "ours": "planners with our additions"}


def draw_figure(path: Path, rates: pd.DataFrame, *, planner: str, criterion: str) -> None:
    """The paper's figure for one kind of planner and one criterion, without its lower row if all have three objects.

    `rates`: as in `cavin_pyro.reproduction.table.rates`. Bars and lines are rates of success, whiskers the wider of the
    two intervals on each side.
    """
    own = rates[(rates["planner"] == planner) & (rates["criterion"] == criterion)]
    tasks = list(own["task"].unique())
    rows = 1 if set(own["objects"]) == {TOP_ROW_OBJECTS} else 2
    figure = Figure(figsize=(3.6 * len(tasks) + 0.4, 2.4 * rows + 0.8), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.subplots(rows, len(tasks), squeeze=False, sharey=True)
    for column, task in zip(axes.T, tasks, strict=True):
        _draw_rewards(column[0], own[(own["task"] == task) & (own["objects"] == TOP_ROW_OBJECTS)])
        column[0].set_title(task)
        if rows == 2:
            _draw_objects(column[1], own[(own["task"] == task) & (own["reward"] == "sparse")])
    for row in axes:
        row[0].set_ylabel("success, %")
    handles, labels = axes[-1][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 2 * len(tasks)), frameon=False)
    figure.suptitle(f"{TITLES[planner]}; criterion: {criterion}", fontsize=10)
    save_figure(path, figure)


def _draw_rewards(axes: Axes, rates: pd.DataFrame) -> None:
    """Dense and sparse rewards, three objects."""
    width = GROUP_WIDTH / max(1, rates["method"].nunique())
    for method, offset, own in _by_method(rates):
        places = [REWARDS.index(reward) + offset * width for reward in own["reward"]]
        axes.bar(places, 100 * own["rate"], 0.9 * width, color=method.color, label=method.label)
        axes.errorbar(places, 100 * own["rate"], _whiskers(own), fmt="none", ecolor="black", capsize=2, linewidth=0.8)
    axes.set_xticks(range(len(REWARDS)), [f"{kind} reward" for kind in REWARDS])
    axes.set_xlabel(_episodes(rates), fontsize=8)
    axes.set_xlim(-0.5, len(REWARDS) - 0.5)
    axes.set_ylim(0, 104)


def _draw_objects(axes: Axes, rates: pd.DataFrame) -> None:
    """Sparse rewards, against the number of objects."""
    for method, offset, own in _by_method(rates):
        style: dict[str, Any] = {"color": method.color, "marker": "o", "markersize": 4, "capsize": 2, "linewidth": 1.2}
        axes.errorbar(own["objects"] + DODGE * offset, 100 * own["rate"], _whiskers(own), label=method.label, **style)
    axes.set_xticks(sorted(rates["objects"].unique()))
    others = _episodes(rates[rates["objects"] != TOP_ROW_OBJECTS])
    axes.set_xlabel(f"objects ({others}, but with {TOP_ROW_OBJECTS} as above)" if others else "objects", fontsize=8)


def _by_method(rates: pd.DataFrame) -> Iterator[tuple[Method, float, pd.DataFrame]]:
    """The methods that have episodes, each with its offset from the middle of all and its rates by objects."""
    present = [name for name in METHODS if name in set(rates["method"])]
    for number, name in enumerate(present):
        own = rates[rates["method"] == name].sort_values("objects")
        yield METHODS[name], number - (len(present) - 1) / 2, own


def _episodes(rates: pd.DataFrame) -> str:
    """How many episodes a bar or a point has."""
    counts = sorted(set(rates["episodes"]))
    return " to ".join(map(str, dict.fromkeys((counts[0], counts[-1])))) + " episodes each" if counts else ""


def _whiskers(rates: pd.DataFrame) -> np.ndarray:
    """Lengths below and above each rate [2, N], in points."""
    low, high = rates[["low", "seed_low"]].min(axis=1), rates[["high", "seed_high"]].max(axis=1)
    return 100 * np.clip(np.stack([rates["rate"] - low, high - rates["rate"]]), 0, None)
