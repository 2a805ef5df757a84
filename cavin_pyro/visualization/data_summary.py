"""A picture of a dataset: how far pushes move objects, how many of them, and where on the table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from cavin_pyro.data.summary import CELL, DISTANCES, SEGMENT, DataSummary
from cavin_pyro.envs.tabletop.workspace import REACH_HIGH, REACH_LOW, TABLE_HIGH, TABLE_LOW
from cavin_pyro.visualization.training import DOTS_PER_INCH, save_figure

ONE, SEVERAL = "#0072B2", "#D55E00"
MAPS = {
    "observed": "observed objects",
    "pushed": "objects before a push that moved them",
    "started": "starts of pushes",
}


def draw_data(path: Path, summary: DataSummary) -> None:
    """Draw a dataset's counts, as shares of its pushes or episodes."""
    figure = Figure(figsize=(11.0, 5.2), dpi=DOTS_PER_INCH, layout="constrained")
    rows = figure.subfigures(2, 1, height_ratios=[1.1, 1.0])
    distance, moved, objects = rows[0].subplots(1, 3, width_ratios=[2.0, 1.0, 1.0])
    _draw_distances(distance, summary)
    _draw_counts(moved, summary.objects_moved, "objects that a push moves", "% of pushes")
    _draw_counts(objects, summary.objects, "objects on the table", "% of episodes")
    for panel, (name, title) in zip(rows[1].subplots(1, len(MAPS)), MAPS.items(), strict=True):
        _draw_map(panel, getattr(summary, name), title)
    save_figure(path, figure)


def _draw_distances(panel: Axes, summary: DataSummary) -> None:
    curves = ((summary.farthest, ONE, "one push"), (summary.farthest_in_segment, SEVERAL, f"{SEGMENT} pushes in a row"))
    for counts, color, label in curves:
        panel.stairs(_percent(counts), 100 * DISTANCES, color=color, linewidth=1.5, label=label)
    panel.set_yscale("log")
    panel.set_xlabel(f"move of the object that moves farthest (cm; last: {100 * DISTANCES[-2]:g} and more)", fontsize=9)
    panel.set_ylabel("%", fontsize=9)
    panel.legend(fontsize=9, frameon=False)
    _tidy(panel)


def _draw_counts(panel: Axes, counts: NDArray[np.int64], title: str, unit: str) -> None:
    panel.bar(range(len(counts)), _percent(counts), color=ONE, width=0.7)
    panel.set_xticks(range(len(counts)))
    panel.set_xlabel(title, fontsize=9)
    panel.set_ylabel(unit, fontsize=9)
    _tidy(panel)


def _draw_map(panel: Axes, counts: NDArray[np.int64], title: str) -> None:
    """The table from above as the camera sees it: up is +x, left is +y."""
    edges = [low + CELL * np.arange(n + 1) for low, n in zip(TABLE_LOW, counts.shape, strict=True)]
    mesh = panel.pcolormesh(edges[1], edges[0], _percent(counts), cmap="viridis", vmin=0.0)
    for low, high, color, style in ((TABLE_LOW, TABLE_HIGH, "black", "-"), (REACH_LOW, REACH_HIGH, "white", "--")):
        sides = high[1] - low[1], high[0] - low[0]
        panel.add_patch(Rectangle((low[1], low[0]), *sides, fill=False, edgecolor=color, linestyle=style))
    panel.invert_xaxis()
    panel.set(aspect="equal")
    panel.set_title(title, fontsize=10)
    panel.set_xlabel("y (m)", fontsize=8)
    panel.set_ylabel("x (m)", fontsize=8)
    panel.tick_params(labelsize=7)
    assert panel.figure is not None
    bar = panel.figure.colorbar(mesh, ax=panel, shrink=0.9)
    bar.set_label("% per cell of 2 cm", fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _percent(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    return 100.0 * counts / max(int(counts.sum()), 1)


def _tidy(panel: Axes) -> None:
    panel.grid(color="#DDDDDD", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8)
