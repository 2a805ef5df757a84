"""Use of the codes' dimensions."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from cavin_pyro.criticism.statistics.codes import SYMBOLS
from cavin_pyro.criticism.statistics.inference.information import ACTIVE


def draw_dimensions(values: dict[str, Any], codes: tuple[str, ...]) -> Figure:
    """Per dimension of each code, the variance of the posterior mean and the mean KL, from the check's values."""
    figure = Figure(figsize=(5.0 * len(codes), 4.4), layout="constrained")
    for column, name in zip(figure.subplots(2, len(codes), squeeze=False).T, codes, strict=True):
        one, places = values[name], range(values[name]["dimensions"])
        column[0].bar(places, [max(value, 1e-4) for value in one["mean_variance"]], color="#0072B2")
        column[0].axhline(ACTIVE, color="#9A9A9A", linestyle="--", linewidth=1.0)
        column[0].set(yscale="log", ylim=(1e-4, 3.0), title=SYMBOLS[name], ylabel="variance of the mean")
        if one["kl_by_dimension"] is not None:
            column[1].bar(places, one["kl_by_dimension"], color="#D55E00")
        column[1].set(xlabel="dimension", ylabel="mean KL (nats)")
        for panel in column:
            panel.spines[["top", "right"]].set_visible(False)
            panel.tick_params(labelsize=8)
    return figure
