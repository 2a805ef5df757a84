"""Bounds on the evidence, and tails of importance weights."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from matplotlib.figure import Figure

from cavin_pyro.criticism.statistics.clusters import mean_with_error
from cavin_pyro.criticism.statistics.inference.importance import Weights

COLORS = {
    "joint": "#000000",
    "effect_code": "#0072B2",
    "effect_code_given_subgoal": "#56B4E9",
    "motion_code": "#D55E00",
}


def draw_guide_error(found: Mapping[str, Weights], labels: Mapping[str, str]) -> Figure:
    """How far each bound rises with more particles, and the distribution of k-hat over windows."""
    figure = Figure(figsize=(10.0, 3.6), layout="constrained")
    rises, tails = figure.subplots(1, 2)
    for name, weights in found.items():
        base = weights.bounds[min(weights.bounds)]
        errors = [mean_with_error(bound - base, weights.episodes) for bound in weights.bounds.values()]
        heights, bars = [error["mean"] for error in errors], [2 * error["standard_error"] for error in errors]
        rises.errorbar(list(weights.bounds), heights, bars, color=COLORS[name], marker="o", label=labels[name])
        # A line, not bars: where several cumulative shares lie above one another, all stay visible.
        ordered = weights.shapes.clamp(-0.5, 2.0).sort().values
        tails.plot(
            ordered, torch.arange(1, len(ordered) + 1) / len(ordered), color=COLORS[name], drawstyle="steps-post"
        )
    rises.set(xscale="log", xlabel="particles K", ylabel="bound minus ELBO (nats)")
    tails.axvline(next(iter(found.values())).limit, color="#9A9A9A", linestyle="--", linewidth=1.0)
    tails.set(xlabel="k-hat (cut off at -0.5 and 2)", ylabel="share of windows below", xlim=(-0.55, 2.05), ylim=(0, 1))
    figure.legend(*rises.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    for panel in (rises, tails):
        panel.grid(color="#DDDDDD", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
    return figure
