"""Histograms of observed and generated statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.criticism.statistics.pushing import Statistic

COLORS = {"prior_means": "#0072B2", "prior": "#56B4E9", "guide_means": "#D55E00", "guide": "#E69F00"}
OBSERVED = "#BBBBBB"
BINS = 32
COLUMNS = 3

Samples = Mapping[str, Tensor]  # of each statistic, any shape


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
        real, replicated = _finite(observed[name]), {key: _finite(samples[name]) for key, samples in generated.items()}
        edges = _edges(statistic, [real, *replicated.values()])
        panel.stairs(_shares(real, edges), edges, fill=True, color=OBSERVED)
        for source, values in replicated.items():
            style = "-" if source.endswith("means") else "--"
            panel.stairs(_shares(values, edges), edges, color=COLORS[source], linewidth=1.6, linestyle=style)
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
    handles: list[Any] = [Patch(color=OBSERVED, label="observed")]
    for source in generated:
        style = "-" if source.endswith("means") else "--"
        handles.append(Line2D([], [], color=COLORS[source], linestyle=style, label=labels[source]))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=10, frameon=False)
    return figure


def _finite(values: Tensor) -> NDArray[np.floating]:
    flat = values.flatten().numpy()
    return flat[np.isfinite(flat)]


def _edges(statistic: Statistic, samples: Sequence[NDArray[np.floating]]) -> NDArray[np.floating]:
    """Ends of the bins: around each possible value, or evenly over nearly all of the samples [n]."""
    if statistic.counts is not None:
        highest = max(round(float(values.max(initial=0.0)) / statistic.counts) for values in samples)
        return (np.arange(max(highest, 1) + 2) - 0.5) * statistic.counts
    high = max(float(np.quantile(values, 0.98)) for values in samples if len(values)) if any(map(len, samples)) else 1
    return np.linspace(0.0, max(high, 1e-3), BINS + 1)


def _shares(values: NDArray[np.floating], edges: NDArray[np.floating]) -> NDArray[np.floating]:
    """What share of the values [n] lies in each bin; the last one takes all that is higher."""
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    return counts / max(1, len(values))


def _label(panel: Axes, statistic: Statistic, edges: NDArray[np.floating]) -> None:
    if statistic.name.startswith("close_pairs"):  # rare, so that its share shows on a log axis only
        panel.set(yscale="log", ylim=(1e-4, 1.5))
    panel.yaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8)
    if statistic.unit == "m":
        panel.xaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f}")
        panel.set_xlabel("cm", fontsize=9)
        return
    values = (edges[:-1] + edges[1:]) / 2
    panel.set_xticks(values, [f"{value:.2g}" for value in values.round(3) + 0.0])
    panel.set_xlabel("share of the window's pushes" if statistic.counts != 1.0 else "number per window", fontsize=9)
