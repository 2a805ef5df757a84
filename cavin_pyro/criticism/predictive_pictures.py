"""Histograms of what was observed against what the model generated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from cavin_pyro.criticism.pushing import Statistic

COLORS = {"prior_means": "#0072B2", "prior": "#56B4E9", "guide_means": "#D55E00", "guide": "#E69F00"}
OBSERVED = "#BBBBBB"
BINS = 32
COLUMNS = 3

Samples = Mapping[str, NDArray[np.floating]]  # of each statistic: [n]


def draw_histograms(
    statistics: Sequence[Statistic],
    observed: Samples,
    generated: Mapping[str, Samples],
    labels: Mapping[str, str],
    results: Mapping[str, Any],
) -> Figure:
    """A panel for every statistic: observed windows filled, those of each source as a line.

    Args:
        generated: of each source. labels: of each source. results: of each statistic and source, `mean.tail`.
    """
    rows = -(-len(statistics) // COLUMNS)
    figure = Figure(figsize=(13.0, 0.7 + 3.0 * rows), dpi=100, layout="constrained")
    axes = figure.subplots(rows, COLUMNS, squeeze=False)
    for panel, statistic in zip(axes.flat, statistics, strict=False):
        name = statistic.name
        edges = _edges(statistic, [observed[name], *(samples[name] for samples in generated.values())])
        _fill(panel, observed[name], edges)
        for source, samples in generated.items():
            _line(panel, samples[name], edges, COLORS[source], dashed=not source.endswith("means"))
        tails = [
            f"P = {results[name][source]['mean']['tail']:.2f} {source.partition('_')[0]}"
            for source in ("prior_means", "guide_means")
            if source in results[name]
        ]
        panel.set_title(f"{statistic.label}\n{', '.join(tails)}", fontsize=9.5)
        _label(panel, statistic, edges)
    for panel in axes.flat[len(statistics) :]:
        panel.set_axis_off()
    for row in axes:
        row[0].set_ylabel("share", fontsize=9)
    handles, _ = axes.flat[0].get_legend_handles_labels()
    names = ["observed", *(labels[source] for source in generated)]
    figure.legend(handles, names, loc="outside upper center", ncols=len(names), fontsize=10, frameon=False)
    return figure


def _edges(statistic: Statistic, samples: Sequence[NDArray[np.floating]]) -> NDArray[np.floating]:
    pooled = np.concatenate([values[np.isfinite(values)] for values in samples])
    if len(pooled) == 0:
        return np.array([0.0, 1.0])
    if statistic.counts is not None:
        highest = round(float(pooled.max()) / statistic.counts)
        return (np.arange(max(highest, 1) + 2) - 0.5) * statistic.counts
    high = max(
        float(np.quantile(values[np.isfinite(values)], 0.995)) for values in samples if np.isfinite(values).any()
    )
    return np.linspace(0.0, max(high, 1e-3), BINS + 1)


def _shares(values: NDArray[np.floating], edges: NDArray[np.floating]) -> NDArray[np.floating]:
    """What share of the values lies in each bin; the last one takes all that is higher."""
    finite = values[np.isfinite(values)]
    counts, _ = np.histogram(np.clip(finite, edges[0], edges[-1]), edges)
    return counts / max(1, len(finite))


def _fill(panel: Axes, values: NDArray[np.floating], edges: NDArray[np.floating]) -> None:
    panel.stairs(_shares(values, edges), edges, fill=True, color=OBSERVED, label="observed")


def _line(panel: Axes, values: NDArray[np.floating], edges: NDArray[np.floating], color: str, *, dashed: bool) -> None:
    style = "--" if dashed else "-"
    panel.stairs(_shares(values, edges), edges, color=color, linewidth=1.6, linestyle=style, label=color)


def _label(panel: Axes, statistic: Statistic, edges: NDArray[np.floating]) -> None:
    panel.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8)
    if statistic.unit == "m":
        panel.xaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f}")
        panel.set_xlabel("cm", fontsize=9)
        return
    values = (edges[:-1] + edges[1:]) / 2
    panel.set_xticks(values, [f"{value:.2g}" for value in values.round(3) + 0.0])
    panel.set_xlabel("share of the window's pushes" if statistic.counts != 1.0 else "number per window", fontsize=9)
