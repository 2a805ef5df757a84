"""Does the predictive distribution look like the data? Statistics of generated windows.

After Gelman, Meng and Stern, "Posterior predictive assessment of model fitness via realized discrepancies", 1996.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.criticism.estimates import Interval, mean_interval
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.pushing import Nearness, Statistic, length_text, statistics_of
from cavin_pyro.criticism.section import Section, conclude, within, worst
from cavin_pyro.criticism.windows import generated, observed, replicated, seeded
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model
from cavin_pyro.models.state import Window

SOURCES = {
    "prior_means": "prior, as planned",
    "prior": "prior, as sampled",
    "guide_means": "guide, means",
    "guide": "guide, as sampled",
}
SMALL_EFFECT, LARGE_EFFECT = (-0.2, 0.2), (-0.8, 0.8)  # by Cohen's (1988) convention
COLORS = {"prior_means": "#0072B2", "prior": "#56B4E9", "guide_means": "#D55E00", "guide": "#E69F00"}
COLUMNS = 4

EXPLANATION = (
    "{replicates} datasets were generated from the first states of {windows} held-out windows. These are a "
    "selection: something moved, as in training. Codes come from the prior (prior predictive) or from the guide, which "
    'infers from the whole window (posterior predictive). "As sampled" has the noise of the likelihoods; "means" and '
    '"as planned" have all but the codes at their means, as a planner has it. The tail probability is the share of '
    "datasets whose mean is at least the observed one: near 0 the model makes too little of it, near 1 too much. Two "
    "objects are inside each other where their centres are nearer than {pair}, nearer than in all but 1 % of the "
    "training windows."
)
TOUCH = (
    " A push touches where its path comes within {tool} of a centre, as often in training windows as pushes move an "
    "object by 1 cm."
)


@torch.no_grad()
def assess_predictive(context: CheckContext, *, windows: int = 400, replicates: int = 200) -> Section:
    """Prior and posterior predictive checks on held-out windows.

    `windows`: held-out windows, at most. `replicates`: datasets generated per source.
    """
    window, episodes = context.held_out(windows)
    nearness = Nearness.of(observed(context.training), context.space)
    sources = [name for name in SOURCES if context.codes or name.startswith("prior")]
    drawn: dict[str, dict[str, Tensor]] = {}
    with seeded(context.seed):
        outcome = generated(context.model, window)
        missing = {"h": outcome.subgoal is None, "g": not outcome.chosen}
        statistics = [
            statistic for statistic in statistics_of(nearness, context.space) if not missing.get(statistic.part)
        ]
        for source in sources:
            guide = context.guide if source.startswith("guide") else None
            means = context.codes if source.endswith("means") else None
            drawn[source] = replicate(
                context.model, window, statistics, replicates=replicates, guide=guide, means=means
            )
    real = {statistic.name: statistic.function(observed(window)) for statistic in statistics}
    compared = {
        statistic.name: {source: compare(drawn[source][statistic.name], real[statistic.name]) for source in sources}
        for statistic in statistics
    }
    effects = {one.name: effect_size(drawn["prior_means"][one.name], real[one.name], episodes) for one in statistics}
    # A statistic that is the same in all real windows has no scale to compare with.
    sizes = {name: effect for name, effect in effects.items() if effect.mean == effect.mean}
    largest = max(sizes, key=lambda name: abs(sizes[name].mean), default=None)
    labels = {one.name: one.label for one in statistics}
    level = worst(within(one.low, one.high, good=SMALL_EFFECT, bad=LARGE_EFFECT) for one in sizes.values())
    return Section(
        EXPLANATION.format(replicates=replicates, windows=len(episodes), pair=length_text(nearness.pair, context.space))
        + (TOUCH.format(tool=length_text(nearness.tool, context.space)) if nearness.tool else ""),
        conclude(
            level,
            "The difference of each statistic, as planned, from the observed one, in standard deviations of single "
            f"windows: good if every 95 % interval over episodes lies within {SMALL_EFFECT[1]:g}, bad if one is beyond "
            f"{LARGE_EFFECT[1]:g}." + (f" Largest: {labels[largest]}." if largest else ""),
            "See which part (h, f or g) the statistic belongs to, and whether codes from the guide have it too.",
            episodes,
        ),
        [_finding(one, real[one.name], compared[one.name]) for one in statistics],
        {
            "windows": len(episodes),
            "replicates": replicates,
            "pair_distance": nearness.pair,
            "tool_distance": nearness.tool,
            "statistics": {
                name: {"observed": real[name].mean().item(), **each, "effect": effects[name]}
                for name, each in compared.items()
            },
        },
        f"{labels[largest]}, as planned minus observed (standard deviations)" if largest else "",
        sizes[largest] if largest else None,
        figure=draw_statistics(statistics, real, drawn),
        caption="Distribution of each statistic in observed windows (grey) and generated ones.",
    )


def replicate(
    model: Model,
    window: Window,
    statistics: Sequence[Statistic],
    *,
    replicates: int,
    guide: Guide | None = None,
    means: Sequence[str] | None = None,
) -> dict[str, Tensor]:
    """Each statistic of `replicates` (R) datasets generated for windows `[B]`: `[R, B]` or `[R, B, T]`.

    `guide` and `means` are those of `windows.generated`.
    """

    def made(copies: Window) -> dict[str, Tensor]:
        outcome = generated(model, copies, guide=guide, means=means)
        return {statistic.name: statistic.function(outcome) for statistic in statistics}

    return replicated(window, replicates, made)


def compare(values: Tensor, real: Tensor) -> dict[str, float]:
    """The mean of replicates `values: [R, ...]` and its tail probability P(mean(rep) >= mean(obs)), for `real: [...]`.

    Ties count half: means of counts tie often, most of all where nothing of the kind happens.
    """
    means, wanted = values.flatten(1).double().mean(1), real.double().mean()
    tail = (means > wanted).double().mean() + (means == wanted).double().mean() / 2
    return {"mean": means.mean().item(), "tail": tail.item()}


def effect_size(replicated: Tensor, real: Tensor, episodes: Tensor) -> Interval:
    """How much more the model has than was observed, in standard deviations of single windows; NaN if these are 0.

    `replicated`: `[R, B]` or `[R, B, T]`. `real`: `[B]` or `[B, T]`.
    """
    count = len(episodes)
    expected = replicated.double().mean(0).reshape(count, -1).mean(-1)
    observed = real.double().reshape(count, -1).mean(-1)
    spread = observed.std() if count > 1 else torch.tensor(0.0)
    return mean_interval((expected - observed) / spread.where(spread > 0, torch.nan), episodes)


def _finding(statistic: Statistic, real: Tensor, compared: Mapping[str, Mapping[str, float]]) -> str:
    unit, factor = (" cm", 100) if statistic.unit == "m" else ("", 1)
    planned = compared["prior_means"]
    texts = [f"{factor * planned['mean']:.3g}{unit} as planned"]
    if "guide_means" in compared:
        texts.append(f"{factor * compared['guide_means']['mean']:.3g}{unit} with codes from the guide")
    return (
        f"{statistic.label[0].upper()}{statistic.label[1:]}: {factor * real.mean().item():.3g}{unit} in real windows, "
        f"{', '.join(texts)} (tail probability {planned['tail']:.2f} as planned)."
    )


def draw_statistics(
    statistics: Sequence[Statistic], observed: Mapping[str, Tensor], generated: Mapping[str, Mapping[str, Tensor]]
) -> Figure:
    """A panel for every statistic: the distribution over observed windows, and over those of each source."""
    columns = min(COLUMNS, len(statistics))
    rows = -(-len(statistics) // columns)
    figure = Figure(figsize=(3.2 * columns, 0.5 + 2.5 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).flatten()
    for panel, statistic in zip(axes, statistics, strict=False):
        factor = 100 if statistic.unit == "m" else 1
        panel.ecdf(quantiles(factor * observed[statistic.name]), color="#BBBBBB", linewidth=4, label="observed")
        for source, values in generated.items():
            panel.ecdf(quantiles(factor * values[statistic.name]), color=COLORS[source], label=SOURCES[source])
        panel.set_title(statistic.label, fontsize=8)
        panel.set_xlabel("cm" if factor == 100 else "")
    for panel in axes[len(statistics) :]:
        panel.set_axis_off()
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), fontsize=8, frameon=False)
    return figure


def quantiles(values: Tensor) -> NDArray[np.floating]:
    """201 quantiles, which draw as the distribution of all `values: [...]` does."""
    return np.quantile(values.flatten().numpy(), np.linspace(0, 1, 201))
