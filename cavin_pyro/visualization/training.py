"""Pictures of training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from cavin_pyro.storage.files import atomic_write

DOTS_PER_INCH = 120
COLORS = {"training": "#0072B2", "validation": "#D55E00"}
COLUMNS = 3  # of panels


def save_figure(path: Path, figure: Figure) -> None:
    """Write a figure as an image, atomically."""
    with atomic_write(path) as temporary:
        figure.savefig(temporary, facecolor="white")


def draw_training(path: Path, rows: Sequence[Mapping[str, str | float]]) -> None:
    """The loss and each term of the objective over training steps, in nats per window or transition that counts.

    `rows`: of a run's metrics.csv, with keys `step`, `training_loss`, `validation_loss` and `validation_<term>`; empty
    cells are skipped.
    """
    table = (
        pd.DataFrame(rows).apply(pd.to_numeric, errors="coerce").replace([np.inf, -np.inf], np.nan).set_index("step")
    )
    panels = list(dict.fromkeys(name.partition("_")[2] for name in table if name.startswith(tuple(COLORS))))
    lines = -(-len(panels) // COLUMNS)
    figure = Figure(figsize=(10.0, 0.6 + 2.1 * lines), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.subplots(lines, COLUMNS, squeeze=False).flat
    for panel, name in zip(axes, panels, strict=False):
        curves = {part: table[f"{part}_{name}"].dropna() for part in COLORS if f"{part}_{name}" in table}
        for part, curve in curves.items():
            panel.plot(curve, color=COLORS[part], linewidth=1.4, marker="o" if len(curve) == 1 else None, label=part)
        later = pd.concat([curve.iloc[len(curve) // 20 :] for curve in curves.values()])
        if len(later) and np.ptp(later) > 0:  # a steep beginning would flatten all that follows
            panel.set_ylim(later.min() - 0.1 * np.ptp(later), later.max() + 0.1 * np.ptp(later))
        panel.set_title(name.replace("_", " "), fontsize=10)
        panel.xaxis.set_major_locator(MaxNLocator(4, integer=True))
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
        panel.set_xlabel("training step", fontsize=9)
        panel.grid(color="#DDDDDD", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(labelsize=8)
    for panel in axes[len(panels) :]:
        panel.set_axis_off()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(COLORS), frameon=False)
    save_figure(path, figure)
