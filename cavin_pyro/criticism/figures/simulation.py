"""Ranks of simulation-based calibration."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from cavin_pyro.criticism.statistics.codes import SYMBOLS

BINS = 20


def draw_ranks(ranks: Mapping[str, Tensor]) -> Figure:
    """Histograms of ranks `[B, D]` in [0, 1], a panel for each code and a line for each dimension."""
    figure = Figure(figsize=(4.6 * len(ranks), 3.2), layout="constrained")
    for panel, (name, values) in zip(figure.subplots(1, len(ranks), squeeze=False)[0], ranks.items(), strict=True):
        for column in values.T:
            counts, edges = np.histogram(column.numpy(), BINS, (0.0, 1.0))
            panel.stairs(counts * BINS / len(column), edges, color="#0072B2", alpha=0.5, linewidth=1.0)
        panel.axhline(1.0, color="black", linestyle=":", linewidth=1.0)
        panel.set(xlim=(0, 1), xlabel="rank", ylabel="density", title=SYMBOLS[name])
        panel.set_ylim(bottom=0)
        panel.spines[["top", "right"]].set_visible(False)
    return figure
