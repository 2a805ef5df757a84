"""Gaps of single windows."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure
from torch import Tensor


def draw_gaps(gap: Tensor, left: Tensor) -> Figure:
    """Histograms of the amortization gap and of the approximation gap, `[B]` nats each, with their means."""
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    panel = figure.subplots()
    # The few windows with huge gaps would leave one bar for all others.
    end = torch.cat((gap, left)).quantile(0.95).item()
    edges = torch.linspace(min(0.0, gap.min().item(), left.min().item()), max(end, 1e-3), 31).tolist()
    for name, values, color in (("amortization", gap, "#0072B2"), ("approximation (at least)", left, "#D55E00")):
        panel.hist(values.clamp(max=edges[-1]).numpy(), edges, histtype="step", linewidth=1.6, color=color, label=name)
        panel.axvline(values.mean().item(), color=color, linestyle="--", linewidth=1.0)
    panel.set(xlabel="gap (nats)", ylabel="windows")
    panel.legend(fontsize=9, frameon=False)
    panel.spines[["top", "right"]].set_visible(False)
    return figure
