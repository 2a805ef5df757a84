"""Curves of the error over segments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#888888")


def draw_growth(results: Mapping[str, Sequence[Mapping[str, float]]]) -> Figure:
    """Median and quartiles of each predictor's error after each segment, and how many episodes last.

    Args:
        results: of each predictor, by its label: per segment count, q25, median and q75 (metres).
    """
    figure = Figure(figsize=(8.5, 5.6), dpi=100, layout="constrained")
    panel, below = figure.subplots(2, 1, sharex=True, height_ratios=(5, 1))
    for (label, summaries), color in zip(results.items(), _colors(results), strict=True):
        segments = range(1, len(summaries) + 1)
        low, median, high = ([100 * one[key] for one in summaries] for key in ("q25", "median", "q75"))
        panel.fill_between(segments, low, high, color=color, alpha=0.18, linewidth=0)
        panel.plot(segments, median, "o-", color=color, markersize=4, linewidth=1.6, label=label)
    counts = [one["count"] for one in next(iter(results.values()))]
    below.bar(range(1, len(counts) + 1), counts, color="#BBBBBB", width=0.5)
    below.set_xticks(range(1, len(counts) + 1))
    below.set_xlabel("segments", fontsize=10)
    below.set_ylabel("episodes", fontsize=10)
    panel.set_ylabel("mean distance of centres (cm)", fontsize=10)
    panel.set_ylim(bottom=0.0)
    panel.legend(fontsize=9, frameon=False, loc="upper left")
    for axes in (panel, below):
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=9)
    return figure


def _colors(results: Mapping[str, object]) -> list[str]:
    # "Nothing moves" comes last and is grey, with or without an h.
    return [*COLORS[: len(results) - 1], COLORS[-1]]
