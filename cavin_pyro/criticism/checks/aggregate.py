"""Comparison of inferred codes with the prior's, without their states: for that see `prior.py`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.aggregate import WORST, draw_comparison
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.statistics.codes import SYMBOLS, sample_guide, sample_prior, without_codes
from cavin_pyro.criticism.statistics.inference.information import ACTIVE, posterior_mean_variance
from cavin_pyro.criticism.statistics.prior.two_sample import CodeComparison, TwoSample, compare_codes, energy_test
from cavin_pyro.criticism.statistics.windows import seeded
from cavin_pyro.criticism.verdicts.verdict import conclude, grade

NAME, TITLE = "aggregate_posterior", "Whether inferred codes, without their states, are spread like the prior's"
LEVEL = 0.05
SMALL_DISTANCE, LARGE_DISTANCE = 0.01, 0.05  # energy distances over their largest value, less chance
SAMPLES = 64  # of each window's codes, to find the active dimensions


def assess_aggregate(context: CheckContext, *, windows: int = 1000, permutations: int = 999) -> Section:
    """Two-sample tests of codes from the guide against codes from the prior at the same states.

    For every validation window, one code is sampled from each: from q(. | window), and from p(c | s), p(z | s, c) with
    the prior's own c, as a planner samples them. The energy distance with permutations tests a whole code (and both
    codes together), the Kolmogorov-Smirnov test each dimension.

    Args:
        windows: held-out windows, at most.
        permutations: number of permutations of the energy distance's test.
    """
    if not context.codes:
        return without_codes(NAME, TITLE)
    window, episodes = context.held_out(windows)
    with seeded(context.seed):
        samples = sample_guide(context.guide, window, SAMPLES)
        inferred = {name: value[0] for name, value in samples.items()}
        expected = sample_prior(context.model, window)
    keywords: dict[str, Any] = {"episodes": episodes, "permutations": permutations, "seed": context.seed}
    found = {
        name: compare_codes(
            inferred[name], expected[name], active=posterior_mean_variance(samples[name]) > ACTIVE, **keywords
        )
        for name in context.codes
    }
    together = None
    if len(found) > 1:
        pair = [torch.cat([codes[name] for name in found], -1) for codes in (inferred, expected)]
        together = energy_test(*pair, **keywords)
    explanation = (
        f"One code from the guide and one from the prior for each of {len(window.actions)} validation windows. The "
        "distance is the energy distance over its largest value (0: the same, 1: apart). The test does not see the "
        "state: a prior whose codes belong to other scenes passes it, and it says nothing about sampling from the "
        "prior (see the section prior). With so many windows small differences are detected too: read the distance "
        "along with p, for which the windows of an episode are exchanged together."
    )
    pictures = [_picture(name, comparison) for name, comparison in found.items()]
    values = {name: _values(comparison) for name, comparison in found.items()}
    if together is not None:
        values["together"] = together._asdict()
    tests = [test for one in found.values() for test in (one.whole, one.active) if test] + (
        [together] if together else []
    )
    excess = max(test.distance - test.chance for test in tests)
    verdict = conclude(
        grade(excess, excess, good=SMALL_DISTANCE, bad=LARGE_DISTANCE),
        f"The largest distance beyond chance: good up to {SMALL_DISTANCE:g}, bad from {LARGE_DISTANCE:g}. Good is no "
        "licence to sample from the prior: the section prior decides that.",
        "The prior's spread is wrong for every state: train with prior=mixture or prior=conditional.",
        windows=len(episodes),
        episodes=episodes,
    )
    tables = _tables(found, together)
    return Section(NAME, TITLE, explanation, _findings(found, together), values, tables, pictures, verdict)


def _values(comparison: CodeComparison) -> dict[str, Any]:
    return {
        "windows": len(comparison.guide),
        "all_dimensions": comparison.whole._asdict(),
        "active_dimensions": comparison.active._asdict() if comparison.active else None,
        "dimension_statistics": comparison.statistics.tolist(),
        "dimension_p_values": comparison.p_values.tolist(),
        "means": comparison.guide.double().mean(0).tolist(),
        "deviations": comparison.guide.double().std(0).tolist(),
        "prior_means": comparison.prior.double().mean(0).tolist(),
        "prior_deviations": comparison.prior.double().std(0).tolist(),
    }


def _findings(found: dict[str, CodeComparison], together: TwoSample | None) -> list[str]:
    sentences = []
    for name, comparison in found.items():
        differing = int((comparison.p_values < LEVEL).sum())
        tests = {"all dimensions": comparison.whole, "active dimensions": comparison.active}
        outcomes = "; ".join(f"{label}: {_outcome(test)}" for label, test in tests.items() if test)
        differ = any(test.p_value < LEVEL for test in tests.values() if test)
        verdict = "differ from" if differ else "cannot be distinguished, without their states, from"
        ratio = (comparison.guide.double().std(0) / comparison.prior.double().std(0)).tolist()
        sentences.append(
            f"Inferred {SYMBOLS[name]} {verdict} the prior's ({outcomes}). {differing} of {len(ratio)} dimensions "
            f"differ on their own; their spread is {min(ratio):.2f} to {max(ratio):.2f} times the prior's."
        )
    if together is not None:
        sentences.append(f"Both codes together: {_outcome(together)}.")
    return sentences


def _outcome(test: TwoSample) -> str:
    return f"distance {test.distance:.4f}, {test.chance:.4f} by chance, p = {test.p_value:.3g}"


def _tables(found: dict[str, CodeComparison], together: TwoSample | None) -> list[Table]:
    rows: list[list[Any]] = []
    for name, one in found.items():
        rows.append([SYMBOLS[name], *one.whole])
        if one.active is not None:
            rows.append([f"{SYMBOLS[name]}, active dimensions", *one.active])
    if together is not None:
        rows.append(["both", *together])
    worst: list[list[Any]] = []
    for name, one in found.items():
        for index in one.worst[:WORST]:
            moments = [value for codes in (one.guide, one.prior) for value in _moments(codes[:, index])]
            worst.append(
                [f"{SYMBOLS[name]}[{index}]", *moments, one.statistics[index].item(), one.p_values[index].item()]
            )
    header = ["dimension", "mean", "deviation", "prior's mean", "prior's deviation", "KS statistic", "p (corrected)"]
    return [Table(["code", "energy distance", "by chance", "p"], rows, digits=4), Table(header, worst)]


def _moments(values: Tensor) -> tuple[float, float]:
    return values.double().mean().item(), values.double().std().item()


def _picture(name: str, comparison: CodeComparison) -> Picture:
    caption = (
        f"{SYMBOLS[name]}: the dimensions in which inferred codes differ most from the prior's, and both projected on "
        "the two directions in which their second moments differ most."
    )
    return Picture(f"aggregate_{name}", caption, draw_comparison(name, comparison))
