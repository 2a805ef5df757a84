"""Pictures of training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import NDArray

from cavin_pyro.storage.files import atomic_write
from cavin_pyro.training.trainer import Row

DOTS_PER_INCH = 120
COLORS = {"training": "#0072B2", "validation": "#D55E00"}
RUN_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
COLUMNS = 3  # of panels


def save_figure(path: Path, figure: Figure) -> None:
    """Write a figure as an image, atomically."""
    with atomic_write(path) as temporary:
        figure.savefig(temporary, facecolor="white")


def draw_training(path: Path, rows: Sequence[Mapping[str, str | float]]) -> None:
    """The loss and each term of the objective over training steps.

    `rows`: of a run's metrics.csv, with keys `step`, `training_loss`, `validation_loss` and `validation_<term>`; empty
    cells are skipped.
    """
    terms = [key for key in rows[0] if key.startswith("validation_") and key != "validation_loss"]
    panels = {"loss": {name: (color, _curve(rows, f"{name}_loss")) for name, color in COLORS.items()}}
    panels |= {term: {"validation": (COLORS["validation"], _curve(rows, term))} for term in terms}
    save_figure(path, _draw_panels(panels))


def compare_runs(runs: Mapping[str, Sequence[Row]]) -> Figure:
    """The validation loss and its terms over training steps, in nats per window or transition that counts.

    Args:
        runs: by a name for the legend, at most five, the rows of a run as in `Trainer.rows` or
            `cavin_pyro.training.trainer.read_rows`.

    Raises:
        ValueError: no run, too many of them, or one that has no row yet.
    """
    if not 1 <= len(runs) <= len(RUN_COLORS) or not all(runs.values()):
        raise ValueError(f"give 1 to {len(RUN_COLORS)} runs, each with a validation: {len(runs)} given")
    # Runs of different models do not have the same terms.
    keys = list(dict.fromkeys(key for rows in runs.values() for key in rows[0] if key.startswith("validation_")))
    colored = list(zip(RUN_COLORS, runs.items(), strict=False))
    return _draw_panels({key: {name: (color, _curve(rows, key)) for color, (name, rows) in colored} for key in keys})


Curves = Mapping[str, tuple[str, NDArray[np.float64]]]
"""Of a panel, by names for the legend: colour, and steps and values [n, 2]."""


def _draw_panels(panels: Mapping[str, Curves]) -> Figure:
    """A panel for each column of metrics."""
    lines = -(-len(panels) // COLUMNS)
    figure = Figure(figsize=(10.0, 0.6 + 2.1 * lines), dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.subplots(lines, COLUMNS, squeeze=False)
    for panel, (column, curves) in zip(axes.flat, panels.items(), strict=False):
        _draw_curves(panel, curves, column)
    for panel in axes.flat[len(panels) :]:
        panel.set_axis_off()
    for panel in axes.flat[: len(panels)][-COLUMNS:]:  # the lowest of each column
        panel.set_xlabel("training step", fontsize=9)
    handles = axes[0, 0].get_lines()
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=10, frameon=False)
    return figure


def _curve(rows: Sequence[Mapping[str, Any]], key: str) -> NDArray[np.float64]:
    """Steps and values [n, 2] of the rows that have a finite value."""
    cells = [(float(row["step"]), float(row[key])) for row in rows if row.get(key, "") not in ("", None)]
    curve = np.array(cells, dtype=np.float64).reshape(-1, 2)
    return curve[np.isfinite(curve).all(axis=1)]


def _draw_curves(panel: Axes, curves: Curves, column: str) -> None:
    for name, (color, curve) in curves.items():
        panel.plot(*curve.T, color=color, linewidth=1.4, marker="o" if len(curve) == 1 else None, label=name)
    values = np.concatenate([curve[:, 1] for _, curve in curves.values()])
    later = np.concatenate([curve[len(curve) // 20 :, 1] for _, curve in curves.values()])
    # A steep beginning would flatten all that follows.
    if len(values) and values.min() > 0 and values[0] > 20 * values[-1]:
        panel.set_yscale("log")
    elif len(values) and np.ptp(values) > 4 * np.ptp(later) > 0:
        margin = 0.1 * np.ptp(later)
        panel.set_ylim(later.min() - margin, later.max() + margin)
    panel.set_title(column.removeprefix("validation_").replace("_", " "), fontsize=10)
    panel.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    panel.xaxis.set_major_formatter(EngFormatter(sep=""))
    panel.grid(color="#DDDDDD", linewidth=0.6)
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8)
