"""Codes of the guide against codes of the prior, given the state."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.figure import Figure
from torch import Tensor

from cavin_pyro.criticism.statistics.prior.classifier import ClassifierTest
from cavin_pyro.criticism.statistics.prior.expected_coverage import LEVELS

NAMES = {"prior": "prior", "shuffled": "prior of\nanother scene"}
COLORS = {"prior": "#0072B2", "shuffled": "#D55E00"}
STYLES = {"codes": "-", "first push": "--"}


def draw_prior(tests: Mapping[str, ClassifierTest], curves: Mapping[str, Mapping[str, Tensor]]) -> Figure:
    """AUC by source, and expected coverage by space and source."""
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    shares, coverage = figure.subplots(1, 2)
    for place, (source, test) in enumerate(tests.items()):
        mean, low, high = test.auc
        shares.errorbar(
            [place], [mean], [[max(0.0, mean - low)], [max(0.0, high - mean)]], fmt="o", capsize=4, color=COLORS[source]
        )
    shares.axhline(0.5, color="#9A9A9A", linestyle="--", linewidth=1.0)
    shares.set(xlim=(-0.6, 1.6), ylim=(0.3, 1.02), ylabel="AUC of a classifier")
    shares.set_xticks(range(len(tests)), [NAMES[source] for source in tests])
    for space, found in curves.items():
        for source, curve in found.items():
            label = f"{space}, {NAMES[source]}".replace("\n", " ")
            coverage.plot(LEVELS, curve, STYLES[space], color=COLORS[source], label=label)
    coverage.plot((0, 1), (0, 1), ":", color="black", linewidth=1.0)
    coverage.set(xlim=(0, 1), ylim=(0, 1), xlabel="level", ylabel="expected coverage")
    coverage.legend(fontsize=8, frameon=False)
    for panel in (shares, coverage):
        panel.spines[["top", "right"]].set_visible(False)
    return figure
