"""Training runs beside one another: the loss and each of its terms, a line per run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from cavin_pyro.training import Row

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
COLUMNS = 3


def compare_runs(runs: Mapping[str, Sequence[Row]]) -> Figure:
    """The validation loss and its terms over training steps, in nats per window or transition that counts.

    Args:
        runs: by a name for the legend, at most five, the rows of a run as of `Trainer.rows` or
            `cavin_pyro.training.read_rows`.

    Raises:
        ValueError: no run, too many of them, or one that has no row yet.
    """
    if not 1 <= len(runs) <= len(COLORS) or not all(runs.values()):
        raise ValueError(f"give 1 to {len(COLORS)} runs, each with a validation: {len(runs)} given")
    # Runs of different models do not have the same terms.
    keys = list(dict.fromkeys(key for rows in runs.values() for key in rows[0] if key.startswith("validation_")))
    rows_of_panels = -(-len(keys) // COLUMNS)
    figure = Figure(figsize=(10.0, 0.6 + 2.1 * rows_of_panels), layout="constrained")
    axes = figure.subplots(rows_of_panels, COLUMNS, squeeze=False)
    for panel, key in zip(axes.flat, keys, strict=False):
        for color, (name, rows) in zip(COLORS, runs.items(), strict=False):
            points = [(row["step"], row[key]) for row in rows if key in row]
            panel.plot(*zip(*points, strict=True), color=color, linewidth=1.5, marker="o", markersize=3, label=name)
        panel.set_title(key.removeprefix("validation_").replace("_", " "), fontsize=10)
        panel.grid(color="#E4E4E4", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(labelsize=8)
    for panel in axes.flat[len(keys) :]:
        panel.set_axis_off()
    for panel in axes.flat[: len(keys)][-COLUMNS:]:  # the lowest of each column
        panel.set_xlabel("training step", fontsize=9)
    handles = axes[0, 0].get_lines()
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=10, frameon=False)
    return figure
