"""Predictive checks: whether generated windows look like real ones where it matters for pushing.

After Gelman, Meng and Stern, "Posterior predictive assessment of model fitness via realized discrepancies", 1996.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.criticism.draws import Outcome, generated, observed, repeated, seeded
from cavin_pyro.criticism.predictive_pictures import draw_histograms
from cavin_pyro.criticism.pushing import Nearness, Statistic, statistics_of
from cavin_pyro.criticism.section import Picture, Section, Subject, Table

SOURCES = {
    "prior_means": "prior, as planned",
    "prior": "prior, as drawn",
    "guide_means": "guide, means",
    "guide": "guide, as drawn",
}
QUANTILE = 0.95
EXTREME = 0.01  # a tail probability this near to 0 or 1 tells of a misfit

Values = dict[str, Tensor]  # of each statistic: [R, B] or [R, B, T]

EXPLANATION = """
{replicates} replicated datasets were generated, each with one draw for each of {windows} held-out windows, from their
first states alone. The windows are a selection, as in training: some object moved more than 0.1 m, none more than
0.5 m, and every push was safe. The codes come from the prior, which is what planning samples (prior predictive), or from
the guide, which has seen the whole window (posterior predictive). "As drawn" is the program with the noise of its
likelihoods; "means" and "as planned" have codes drawn and all else at the likelihoods' means, as a planner has it.
The tail probability is the share of replicated datasets whose mean (or 95 % quantile) is at least the observed one (ties
count half): near 0 the model makes too little of it, near 1 too much. Only centres are predicted, so objects stand for discs: two are taken
to be inside each other where their centres are nearer than {pair:.1f} cm in the plane, nearer than in all but 1 % of real
windows; a push touches where its path comes within {tool:.1f} cm of a centre, a distance that as many real pushes come
within as move an object by 1 cm. A push moves an object that goes more than 3 cm.
"""


@torch.no_grad()
def assess_predictive(subject: Subject, *, windows: int = 400, replicates: int = 200) -> Section:
    """Prior and posterior predictive checks on held-out windows.

    Args:
        windows: of `subject.validation` at most. replicates: datasets generated per source.
    """
    window = subject.validation.map(lambda field: field[:windows])
    nearness = Nearness.of(observed(subject.training))
    with seeded(subject.seed):
        sources = {
            name: (subject.guide if name.startswith("guide") else None, name.endswith("means"))
            for name in SOURCES
            if subject.codes or name.startswith("prior")
        }
        first = generated(subject.model, window)
        statistics = [
            statistic
            for statistic in statistics_of(nearness, window.segment_length)
            if not (statistic.part == "h" and first.subgoal is None)
            and not (statistic.part == "g" and not first.chosen)
        ]
        drawn = {
            name: _replicate(subject, window, statistics, guide, means, replicates)
            for name, (guide, means) in sources.items()
        }
    real = {statistic.name: statistic.function(observed(window)) for statistic in statistics}
    results = {
        statistic.name: {
            "observed": _summary(real[statistic.name].unsqueeze(0), statistic),
            **{
                source: _compared(values[statistic.name], real[statistic.name], statistic)
                for source, values in drawn.items()
            },
        }
        for statistic in statistics
    }
    observed_of = {name: value.numpy().ravel() for name, value in real.items()}
    drawn_of = {
        source: {name: value.numpy().ravel() for name, value in values.items()} for source, values in drawn.items()
    }
    figure = draw_histograms(statistics, observed_of, drawn_of, {name: SOURCES[name] for name in drawn}, results)
    return Section(
        name="predictive",
        title="Do generated pushes and their outcomes look real?",
        explanation=" ".join(
            EXPLANATION.format(
                replicates=replicates,
                windows=len(window.actions),
                pair=100 * nearness.pair,
                tool=100 * nearness.tool,
            ).split()
        ),
        findings=list(_findings(statistics, results)),
        values={
            "windows": len(window.actions),
            "replicates": replicates,
            "pair_distance": nearness.pair,
            "tool_distance": nearness.tool,
            "statistics": {
                name: {
                    source: {key: _plain(value) for key, value in summary.items()} for source, summary in rows.items()
                }
                for name, rows in results.items()
            },
        },
        tables=_tables(statistics, results, list(drawn)),
        pictures=[
            Picture(
                "predictive_checks",
                "Observed windows (grey) and generated ones. P is the tail probability of the mean for codes of the "
                "prior as planned, and of the guide with means, where there is one.",
                figure,
            )
        ],
    )


def _replicate(
    subject: Subject, window: Any, statistics: list[Statistic], guide: Any, means: bool, replicates: int
) -> Values:
    parts: dict[str, list[Tensor]] = {statistic.name: [] for statistic in statistics}
    for count, copies in repeated(window, replicates):
        outcome: Outcome = generated(subject.model, copies, guide=guide, means=subject.codes if means else None)
        for statistic in statistics:
            parts[statistic.name].append(statistic.function(outcome).unflatten(0, (count, -1)))
    return {name: torch.cat(values) for name, values in parts.items()}


def _summary(values: Tensor, statistic: Statistic) -> dict[str, NDArray[np.float64]]:
    """Test statistics of datasets `values: [R, ...]`: the mean and, of continuous ones, a quantile, each `[R]`."""
    flat = values.flatten(1).double()
    summary = {"mean": flat.nanmean(1)}
    if statistic.counts is None:
        summary[f"q{100 * QUANTILE:.0f}"] = flat.nanquantile(QUANTILE, 1)
    return {name: value.numpy() for name, value in summary.items()}


def _compared(values: Tensor, real: Tensor, statistic: Statistic) -> dict[str, dict[str, float]]:
    """Each test statistic of the replicates: its mean, central 95 % interval, and P(T(rep) >= T(obs)), ties half."""
    target = _summary(real.unsqueeze(0), statistic)
    compared = {}
    for name, each in _summary(values, statistic).items():
        each = each[np.isfinite(each)]
        if len(each) == 0 or not np.isfinite(target[name][0]):
            compared[name] = dict.fromkeys(("mean", "low", "high", "tail"), float("nan"))
            continue
        low, high = np.quantile(each, (0.025, 0.975))
        tail = float((each > target[name][0]).mean() + (each == target[name][0]).mean() / 2)
        compared[name] = {"mean": float(each.mean()), "low": float(low), "high": float(high), "tail": tail}
    return compared


def _plain(value: Any) -> Any:
    return float(value[0]) if isinstance(value, np.ndarray) else value


def _tables(statistics: list[Statistic], results: Mapping[str, Any], sources: list[str]) -> list[Table]:
    rows, tails = [], []
    for statistic in statistics:
        result = results[statistic.name]
        for key, value in result["observed"].items():
            label = f"{key} of {statistic.label}{f' ({statistic.unit})' if statistic.unit else ''}"
            rows.append([label, _plain(value), *(result[source][key]["mean"] for source in sources)])
            tails.append([label, *(result[source][key]["tail"] for source in sources)])
    names = [SOURCES[source] for source in sources]
    return [
        Table(["test statistic", "observed", *names], rows),
        Table(["tail probability of", *names], tails),
    ]


def _findings(statistics: list[Statistic], results: Mapping[str, Any]) -> Iterator[str]:
    for statistic in statistics:
        result = results[statistic.name]
        real, planned = _plain(result["observed"]["mean"]), result["prior_means"]["mean"]
        sentence = (
            f"{statistic.label[0].upper()}{statistic.label[1:]}: {_amount(real, statistic)} on average in real "
            f"windows, {_amount(planned['mean'], statistic)} with codes from the prior as planned"
        )
        if "guide_means" in result:
            sentence += f" and {_amount(result['guide_means']['mean']['mean'], statistic)} with codes from the guide"
        odd = planned["tail"] <= EXTREME or planned["tail"] >= 1 - EXTREME
        yield f"{sentence} (P = {planned['tail']:.2f} for the prior{', a misfit' if odd else ''})."


def _amount(value: float, statistic: Statistic) -> str:
    return f"{100 * value:.1f} cm" if statistic.unit == "m" else f"{value:.3g}"
