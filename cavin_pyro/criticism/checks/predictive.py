"""Predictive checks: whether generated windows look like real ones where it matters for pushing.

After Gelman, Meng and Stern, "Posterior predictive assessment of model fitness via realized discrepancies", 1996.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.predictive import draw_histograms
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.statistics.clusters import Interval, mean_interval
from cavin_pyro.criticism.statistics.pushing import Nearness, Statistic, statistics_of
from cavin_pyro.criticism.statistics.replicates import compare, replicate, summaries
from cavin_pyro.criticism.statistics.windows import Outcome, generated, observed, seeded
from cavin_pyro.criticism.verdicts.verdict import INSPECT, Verdict, conclude, grade, worst

SOURCES = {
    "prior_means": "prior, as planned",
    "prior": "prior, as sampled",
    "guide_means": "guide, means",
    "guide": "guide, as sampled",
}
SMALL_EFFECT, LARGE_EFFECT = 0.2, 0.8  # small and large by Cohen's (1988) convention
EXTREME = 0.01  # a tail probability this near to 0 or 1 is a misfit

# statistic -> source -> mean or q95 -> numbers of `replicates.compare`
Results = dict[str, dict[str, dict[str, dict[str, float]]]]

EXPLANATION = """
{replicates} replicated datasets were generated, each with one sample for each of {windows} held-out windows, from
their first states alone. The windows are a selection, as in training: some object moved more than {minimum:g} m, none
more than {maximum:g} m, and every push was safe. The codes come from the prior, which is what planning samples (prior
predictive), or from the guide, which infers from the whole window (posterior predictive). "As sampled" is the program
with the noise of its likelihoods; "means" and "as planned" have codes sampled and all else at the likelihoods' means,
as a planner has it. The tail probability is the share of replicated datasets whose mean (or 95 % quantile) is at least
the observed one (ties count half): near 0 the model makes too little of it, near 1 too much. Only centres are
predicted, so objects stand for discs: two are taken to be inside each other where their centres are nearer than
{pair:.1f} cm in the plane, nearer than in all but 1 % of the training windows; a push touches where its path comes
within {tool:.1f} cm of a centre, a distance that as many pushes in training windows come within as move an object by 1
cm. The object that a push moves is the one that goes farthest, if that is more than 3 cm.
"""


@torch.no_grad()
def assess_predictive(context: CheckContext, *, windows: int = 400, replicates: int = 200) -> Section:
    """Prior and posterior predictive checks on held-out windows.

    Args:
        windows: held-out windows, at most.
        replicates: datasets generated per source.
    """
    window, episodes = context.held_out(windows)
    nearness = Nearness.of(observed(context.training))
    sources = [name for name in SOURCES if context.codes or name.startswith("prior")]
    replicated, real = {}, {}
    with seeded(context.seed):
        statistics = _that_exist(statistics_of(nearness, window.segment_length), generated(context.model, window))
        for source in sources:
            replicated[source] = replicate(
                context.model,
                window,
                statistics,
                replicates=replicates,
                guide=context.guide if source.startswith("guide") else None,
                means=context.codes if source.endswith("means") else None,
            )
    results: Results = {}
    for statistic in statistics:
        name = statistic.name
        real[name] = statistic.function(observed(window))
        target = summaries(real[name].unsqueeze(0), statistic)
        results[name] = {"observed": {key: {"mean": float(value[0])} for key, value in target.items()}}
        results[name] |= {source: compare(replicated[source][name], real[name], statistic) for source in sources}
    effects = {
        statistic.name: _effect(replicated["prior_means"][statistic.name], real[statistic.name], episodes)
        for statistic in statistics
    }
    numbers = {"replicates": replicates, "windows": len(window.actions)}
    moves = {"minimum": context.selection.minimum_move, "maximum": context.selection.maximum_move}
    distances = {"pair": 100 * nearness.pair, "tool": 100 * nearness.tool}
    return Section(
        name="predictive",
        title="Do generated pushes and their outcomes look real?",
        explanation=" ".join(EXPLANATION.format(**numbers, **distances, **moves).split()),
        findings=list(_findings(statistics, results)),
        values={
            **numbers,
            "pair_distance": nearness.pair,
            "tool_distance": nearness.tool,
            "statistics": results,
            "effects": {name: effect._asdict() for name, effect in effects.items()},
        },
        tables=_tables(statistics, results, sources),
        pictures=[
            Picture(
                "predictive_checks",
                "Observed windows (grey) and generated ones; the last bin holds all that is beyond. P is the tail "
                "probability of the mean, for codes from the prior as planned and for the guide's with means.",
                draw_histograms(statistics, real, replicated, {source: SOURCES[source] for source in sources}, results),
            )
        ],
        verdict=_verdict(effects, {one.name: one.label for one in statistics}, episodes),
    )


def _effect(replicated: Tensor, real: Tensor, episodes: Tensor) -> Interval:
    """How much more the model as planned has than was observed, in standard deviations of single windows.

    Args:
        replicated: `[R, B]` or `[R, B, T]`. real: `[B]` or `[B, T]`.
    """
    expected, observed = replicated.double().nanmean(0), real.double()
    if observed.dim() > 1:
        expected, observed = expected.nanmean(-1), observed.nanmean(-1)
    known = observed[~observed.isnan()]
    spread = known.std().item() if len(known) > 1 else 0.0
    difference = mean_interval(expected - observed, episodes)
    return Interval(*(end / spread for end in difference)) if spread > 0 else Interval(*[math.nan] * 3)


def _verdict(effects: dict[str, Interval], labels: dict[str, str], episodes: Tensor) -> Verdict:
    graded = {
        name: grade(*_from_zero(effect), good=SMALL_EFFECT, bad=LARGE_EFFECT)
        for name, effect in effects.items()
        if math.isfinite(effect.mean)
    }
    level = worst(graded.values()) if graded else INSPECT
    named = [f"{labels[name]} ({effects[name].mean:+.2f})" for name, one in graded.items() if one == level]
    rule = (
        "The difference of each statistic, as planned, from the observed one, in standard deviations of single "
        f"windows: good if every 95 % interval over episodes lies within {SMALL_EFFECT:g}, bad if one lies beyond "
        f"{LARGE_EFFECT:g}. Decided by: {'; '.join(named)}."
    )
    advice = "See which part (h, f or g) the statistic belongs to, and whether codes from the guide have it too."
    return conclude(level, rule, advice, windows=len(episodes), episodes=episodes)


def _from_zero(effect: Interval) -> tuple[float, float]:
    """The ends of the interval of an effect's size."""
    inside = effect.low <= 0 <= effect.high
    return (0.0 if inside else min(abs(effect.low), abs(effect.high))), max(abs(effect.low), abs(effect.high))


def _that_exist(statistics: Sequence[Statistic], outcome: Outcome) -> list[Statistic]:
    """Those of the parts that the model has."""
    missing = [part for part, here in (("h", outcome.subgoal is not None), ("g", outcome.chosen)) if not here]
    return [statistic for statistic in statistics if statistic.part not in missing]


def _tables(statistics: Sequence[Statistic], results: Results, sources: Sequence[str]) -> list[Table]:
    rows, tails = [], []
    for statistic in statistics:
        result = results[statistic.name]
        for key, value in result["observed"].items():
            label = f"{statistic.label}: {key}{f' ({statistic.unit})' if statistic.unit else ''}"
            rows.append([label, value["mean"], *(result[source][key]["mean"] for source in sources)])
            tails.append([label, *(result[source][key]["tail"] for source in sources)])
    names = [SOURCES[source] for source in sources]
    return [Table(["test statistic", "observed", *names], rows), Table(["tail probability", *names], tails)]


def _findings(statistics: Sequence[Statistic], results: Results) -> Iterator[str]:
    for statistic in statistics:
        means = {source: result["mean"] for source, result in results[statistic.name].items()}
        texts = {source: _amount(mean["mean"], statistic) for source, mean in means.items()}
        tail = means["prior_means"]["tail"]
        if math.isnan(tail):
            yield f"{statistic.label[0].upper()}{statistic.label[1:]}: cannot be estimated, too little moves."
            continue
        inferred = f" and {texts['guide_means']} with codes from the guide" if "guide_means" in texts else ""
        odd = ", a misfit" if min(tail, 1 - tail) <= EXTREME else ""
        yield (
            f"{statistic.label[0].upper()}{statistic.label[1:]}: {texts['observed']} on average in real windows, "
            f"{texts['prior_means']} {'with codes from the prior' if inferred else ''} as planned{inferred} "
            f"(tail probability {tail:.2f} as planned{odd})."
        ).replace("  ", " ")


def _amount(value: float, statistic: Statistic) -> str:
    return f"{100 * value:.1f} cm" if statistic.unit == "m" else f"{value:.3g}"
