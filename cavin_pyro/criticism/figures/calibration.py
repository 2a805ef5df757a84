"""PIT histograms and coverage curves."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from cavin_pyro.criticism.statistics.predictions import coverage

COLORS = {"x": "#0072B2", "y": "#D55E00", "z": "#009E73", "feature": "#999999"}
STYLES = {"all": ("-", "#000000"), "moved": ("-", "#0072B2"), "still": ("-", "#D55E00")}
TITLES = {"all": "all objects", "moved": "objects that moved", "still": "objects that lay still"}
BINS = 20
LEVELS = np.linspace(0.02, 0.98, 49)


def draw_calibration(transforms: Mapping[str, Mapping[str, Mapping[str, Tensor]]]) -> Figure:
    """A row per prediction: PIT histograms of all, moved and still objects, and the coverage of x and y.

    Args:
        transforms: of each prediction, by the title of its row, group and coordinate: PIT `[N]`.
    """
    rows = len(transforms)
    figure = Figure(figsize=(14.0, 0.8 + 2.9 * rows), dpi=100, layout="constrained")
    axes = figure.subplots(rows, len(TITLES) + 1, squeeze=False)
    for number, (line, (name, groups)) in enumerate(zip(axes, transforms.items(), strict=True)):
        line[0].set_ylabel(f"{name}\n\ndensity", fontsize=10)
        for panel, (group, title) in zip(line, TITLES.items(), strict=False):
            _histogram(panel, groups[group])
            count = len(groups[group]["x"])
            panel.set_title(f"{title} ({count})", fontsize=10)
        _coverage(line[-1], groups, legend=number == 0)
    handles = [Line2D([], [], color=color, label=name) for name, color in COLORS.items()]
    handles.append(Line2D([], [], color="black", linestyle=":", label="calibrated"))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=10, frameon=False)
    return figure


def _histogram(panel: Axes, pits: Mapping[str, Tensor]) -> None:
    highest = 2.0
    for name, values in pits.items():
        if len(values):
            counts, edges = np.histogram(values.numpy(), BINS, (0.0, 1.0))
            density = counts * BINS / len(values)
            highest = max(highest, density.max())
            panel.stairs(density, edges, color=COLORS[name], linewidth=1.4)
    panel.axhline(1.0, color="black", linestyle=":", linewidth=1.0)
    panel.set(xlim=(0.0, 1.0), ylim=(0.0, 1.05 * highest))
    panel.set_xlabel("PIT", fontsize=9)
    _tidy(panel)


def _coverage(panel: Axes, groups: Mapping[str, Mapping[str, Tensor]], *, legend: bool) -> None:
    for group, (style, color) in STYLES.items():
        planar = torch.cat((groups[group]["x"], groups[group]["y"]))
        if len(planar):
            held = [coverage(planar, level) for level in LEVELS]
            panel.plot(LEVELS, held, style, color=color, linewidth=1.4, label=TITLES[group])
    panel.plot((0, 1), (0, 1), ":", color="black", linewidth=1.0)
    panel.set(xlim=(0, 1), ylim=(0, 1))
    panel.set_title("x and y within central intervals", fontsize=10)
    panel.set_xlabel("nominal share", fontsize=9)
    panel.set_ylabel("observed share", fontsize=9)
    if legend:
        panel.legend(fontsize=8, frameon=False, loc="lower right")
    _tidy(panel)


def _tidy(panel: Axes) -> None:
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8)
