"""Inferred codes against codes from the prior."""

from __future__ import annotations

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from cavin_pyro.criticism.statistics.codes import SYMBOLS
from cavin_pyro.criticism.statistics.prior.two_sample import CodeComparison, projection

COLORS = {"guide": "#0072B2", "prior": "#D55E00"}
WORST = 4  # dimensions shown


def draw_comparison(name: str, comparison: CodeComparison) -> Figure:
    """Histograms of the dimensions that differ most, and both samples on the two directions that differ most."""
    worst = comparison.worst[:WORST]
    figure = Figure(figsize=(3.4 + 2.2 * len(worst), 3.2), layout="constrained")
    *panels, plane = figure.subplots(1, len(worst) + 1, width_ratios=[*[1.0] * len(worst), 1.5])
    for panel, index in zip(panels, worst, strict=True):
        _histogram(panel, comparison.guide[:, index], comparison.prior[:, index])
        panel.set_title(f"{SYMBOLS[name]}[{index}]", fontsize=10)
    if comparison.guide.shape[1] > 1:
        directions = projection(comparison)
        for label, codes in (("prior", comparison.prior), ("guide", comparison.guide)):
            x, y = (codes.double() @ directions).T
            plane.scatter(x, y, s=4, alpha=0.5, linewidths=0, color=COLORS[label])
        plane.set_aspect("equal", adjustable="datalim")
        plane.set_title("directions that differ most", fontsize=10)
    else:
        plane.set_axis_off()
    for panel in figure.axes:
        panel.tick_params(labelsize=8)
        panel.spines[["top", "right"]].set_visible(False)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9, frameon=False
    )
    return figure


def _histogram(panel: Axes, guide: Tensor, prior: Tensor) -> None:
    edges = torch.linspace(min(guide.min(), prior.min()).item(), max(guide.max(), prior.max()).item(), 31).tolist()
    for label, values in (("guide", guide), ("prior", prior)):
        panel.hist(
            values.numpy(), edges, density=True, histtype="step", linewidth=1.5, color=COLORS[label], label=label
        )
    panel.set_yticks([])
