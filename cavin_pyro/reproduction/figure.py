"""The paper's figure: success with dense and sparse rewards, and against the number of objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cavin_pyro.reproduction.methods import METHODS, Method
from cavin_pyro.reproduction.scales import REWARDS, TOP_ROW_OBJECTS
from cavin_pyro.storage.files import atomic_write

DOTS_PER_INCH = 120
GROUP_WIDTH = 0.8  # of the bars of all methods side by side
DODGE = 0.06  # of lines whose whiskers would lie on one another, in objects
TITLES = {"paper": "planners as in the paper", "ours": "planners with our additions"}
Rates = Sequence[Mapping[str, Any]]


def draw_figure(path: Path, rates: Rates, *, planner: str, criterion: str) -> None:
    """Both rows of the paper's figure, for one kind of planner and one criterion.

    Args:
        rates: as in `cavin_pyro.reproduction.statistics.rates`. Bars and lines are rates of success, whiskers the wider
            of the two intervals on each side.
    """
    own = [rate for rate in rates if rate["planner"] == planner and rate["criterion"] == criterion]
    tasks = list(dict.fromkeys(rate["task"] for rate in own))
    figure = Figure(figsize=(3.6 * len(tasks) + 0.4, 5.6), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.subplots(2, len(tasks), squeeze=False, sharey=True)
    for column, task in enumerate(tasks):
        of_task = [rate for rate in own if rate["task"] == task]
        _draw_rewards(axes[0][column], of_task)
        _draw_objects(axes[1][column], of_task)
        axes[0][column].set_title(task)
    for row in axes:
        row[0].set_ylabel("success, %")
    handles, labels = axes[1][0].get_legend_handles_labels()
    columns = min(len(labels), 2 * len(tasks))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
    figure.suptitle(f"{TITLES.get(planner, planner)}; criterion: {criterion}", fontsize=10)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, facecolor="white", metadata={"Software": None})


def _draw_rewards(axes: Axes, rates: Rates) -> None:
    """Dense and sparse rewards, three objects."""
    shown = _shown(rates)
    width = GROUP_WIDTH / max(1, len(shown))
    for number, (name, method) in enumerate(shown.items()):
        chosen = [rate for rate in rates if rate["method"] == name and rate["objects"] == TOP_ROW_OBJECTS]
        for place, kind in enumerate(REWARDS):
            for rate in chosen:
                if rate["reward"] == kind:
                    x = place + (number - (len(shown) - 1) / 2) * width
                    axes.bar(x, 100 * rate["rate"], 0.9 * width, color=method.color)
                    axes.errorbar(x, 100 * rate["rate"], _whiskers([rate]), color="black", capsize=2, linewidth=0.8)
    axes.set_xticks(range(len(REWARDS)), [f"{kind} reward" for kind in REWARDS])
    axes.set_xlabel(_episodes([rate for rate in rates if rate["objects"] == TOP_ROW_OBJECTS]), fontsize=8)
    axes.set_xlim(-0.5, len(REWARDS) - 0.5)
    axes.set_ylim(0, 104)


def _draw_objects(axes: Axes, rates: Rates) -> None:
    """Sparse rewards, against the number of objects."""
    shown = _shown(rates)
    for number, (name, method) in enumerate(shown.items()):
        chosen = [rate for rate in rates if rate["method"] == name and rate["reward"] == "sparse"]
        chosen.sort(key=lambda rate: rate["objects"])
        if chosen:
            axes.errorbar(
                [rate["objects"] + DODGE * (number - (len(shown) - 1) / 2) for rate in chosen],
                [100 * rate["rate"] for rate in chosen],
                _whiskers(chosen),
                color=method.color,
                label=method.label,
                marker="o",
                markersize=4,
                capsize=2,
                linewidth=1.2,
            )
    axes.set_xticks(sorted({rate["objects"] for rate in rates}))
    of_line = [rate for rate in rates if rate["reward"] == "sparse"]
    others = _episodes([rate for rate in of_line if rate["objects"] != TOP_ROW_OBJECTS])
    axes.set_xlabel(f"objects ({others}, but with {TOP_ROW_OBJECTS} as above)" if others else "objects", fontsize=8)


def _shown(rates: Rates) -> dict[str, Method]:
    """The methods that have episodes, in the order of `METHODS`."""
    present = {rate["method"] for rate in rates}
    return {name: method for name, method in METHODS.items() if name in present}


def _episodes(rates: Rates) -> str:
    """How many episodes a bar or a point has."""
    counts = sorted({rate["episodes"] for rate in rates})
    return " to ".join(map(str, dict.fromkeys((counts[0], counts[-1])))) + " episodes each" if counts else ""


def _whiskers(rates: Rates) -> list[list[float]]:
    low = [100 * max(0.0, rate["rate"] - min(rate["low"], rate["seed_low"])) for rate in rates]
    high = [100 * max(0.0, max(rate["high"], rate["seed_high"]) - rate["rate"]) for rate in rates]
    return [low, high]
