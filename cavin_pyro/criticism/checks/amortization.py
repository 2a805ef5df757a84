"""The amortization gap: the gain in ELBO from fitting the guide to each window on its own."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.amortization import draw_gaps
from cavin_pyro.criticism.refinement import refine
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.statistics.clusters import mean_interval, mean_with_error
from cavin_pyro.criticism.statistics.codes import log_weights, without_codes
from cavin_pyro.criticism.statistics.inference.importance import evidence_bounds, pareto_shapes, reliable_limit
from cavin_pyro.criticism.statistics.windows import seeded
from cavin_pyro.criticism.verdicts.verdict import conclude, grade

NAME, TITLE = "amortization", "The amortization gap"
SMALL_GAP, LARGE_GAP = 1.0, 5.0  # nats per window


def assess_amortization(
    context: CheckContext,
    *,
    windows: int = 200,
    steps: int = 400,
    particles: int = 16,
    samples: int = 1000,
) -> Section:
    """The ELBO before and after the guide is refined for each validation window (`refinement.py`), in nats.

    Cremer et al. (2018) split the guide's error in two: the amortization gap, which a better network could close, and
    the approximation gap, which is left to the best member of the guide's family. The first comes out too small where
    the optimizer has not converged, which then counts for the second. The second is measured up to the bound of
    `samples` particles of the refined guide, which lies below the evidence.

    Args:
        windows: held-out windows, at most.
        steps: gradient steps of the refinement.
        particles: samples of the codes per gradient step.
        samples: samples of the codes with which each guide is evaluated, from the same noise.
    """
    if not context.codes:
        return without_codes(NAME, TITLE)
    model, guide = context.model, context.guide
    window, episodes = context.held_out(windows)
    with seeded(context.seed):
        refined = refine(model, guide, window, steps=steps, particles=particles)
    logs = []
    for program in (guide, refined):
        with seeded(context.seed + 1):
            logs.append(log_weights(model, program, window, samples))
    gap = logs[1].mean(0) - logs[0].mean(0)
    bounds = [evidence_bounds(log, [samples])[samples] for log in logs]
    left = bounds[1] - logs[1].mean(0)
    limit = reliable_limit(samples)
    tails = [(pareto_shapes(log) > limit).double().mean().item() for log in logs]
    values: dict[str, Any] = {
        "windows": len(gap),
        "elbo": mean_with_error(logs[0].mean(0), episodes),
        "refined_elbo": mean_with_error(logs[1].mean(0), episodes),
        "gap": mean_with_error(gap, episodes),
        "gap_median": gap.median().item(),
        "approximation_gap": mean_with_error(left, episodes),
        "pareto_k_limit": limit,
        "pareto_k_above_limit": {"guide": tails[0], "refined": tails[1]},
        "bound_gained": mean_with_error(bounds[1] - bounds[0], episodes),
    }
    explanation = (
        f"Each of {len(gap)} validation windows gets a shift and a stretch of its own for every dimension of its "
        f"codes, on top of the guide, by {steps} steps of Adam on the same ELBO. What this gains is the amortization "
        f"gap; what the bound of {samples} particles of the refined guide still lies above its ELBO is (at least) the "
        "approximation gap."
    )
    interval = mean_interval(gap, episodes)
    verdict = conclude(
        grade(interval.low, interval.high, good=SMALL_GAP, bad=LARGE_GAP),
        f"The gap's 95 % interval over episodes: good if it ends below {SMALL_GAP:g} nats, bad if it begins above "
        f"{LARGE_GAP:g}.",
        "Train longer or widen the guide's network; guide=joint reads the pushes too.",
        windows=len(gap),
        episodes=episodes,
    )
    tables, pictures = [_table(values, steps, samples)], [_picture(gap, left)]
    return Section(NAME, TITLE, explanation, _findings(values), values, tables, pictures, verdict)


def _findings(values: dict[str, Any]) -> list[str]:
    gap, left, tails = values["gap"], values["approximation_gap"], values["pareto_k_above_limit"]
    share = gap["mean"] / max(gap["mean"] + left["mean"], 1e-12)
    return [
        f"Refining the guide for each window gains {gap['mean']:.2f} ± {gap['standard_error']:.2f} nats (median "
        f"{values['gap_median']:.2f}); at least {left['mean']:.2f} ± {left['standard_error']:.2f} nats are left to the "
        "shape of the guide.",
        f"So {min(max(share, 0.0), 1.0):.0%} of the known error of the guide is its network's, and the rest its "
        f"family's. k-hat is above {values['pareto_k_limit']:.2f} for {tails['guide']:.0%} of the windows before and "
        f"{tails['refined']:.0%} after.",
    ]


def _table(values: dict[str, Any], steps: int, samples: int) -> Table:
    names = {
        "elbo": "ELBO of the guide",
        "refined_elbo": f"ELBO after {steps} steps for each window",
        "gap": "amortization gap",
        "approximation_gap": "approximation gap (at least)",
        "bound_gained": f"gain of the bound of {samples} particles",
    }
    rows = [[label, values[key]["mean"], values[key]["standard_error"]] for key, label in names.items()]
    return Table(["nats per window", "mean", "standard error"], rows, digits=2)


def _picture(gap: Tensor, left: Tensor) -> Picture:
    caption = "Gaps of single windows, with their means (dashed). The last bar holds all larger ones."
    return Picture("amortization_gap", caption, draw_gaps(gap, left))
