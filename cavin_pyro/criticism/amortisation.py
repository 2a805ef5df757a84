"""The amortisation gap: what the guide would gain if it were fitted to each window on its own."""

from __future__ import annotations

from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from cavin_pyro.criticism.importance import UNRELIABLE, evidence_bounds, pareto_shapes
from cavin_pyro.criticism.refinement import refine
from cavin_pyro.criticism.sampling import log_weights, mean_with_error, seeded, some_windows, without_codes
from cavin_pyro.criticism.section import Picture, Section, Subject, Table

NAME, TITLE = "amortisation", "The amortisation gap"


def assess_amortisation(
    subject: Subject,
    *,
    windows: int = 200,
    steps: int = 400,
    particles: int = 16,
    draws: int = 1000,
) -> Section:
    """The ELBO before and after the guide is refined for each validation window (`refinement.py`), in nats.

    Cremer et al. (2018) split the guide's error in two: the amortisation gap, which a better network could close, and
    the approximation gap, which is left to the best member of the guide's family. The first comes out too small where
    the optimiser has not arrived, which then counts for the second. The second is measured up to the bound of `draws`
    particles of the refined guide, which lies below the evidence.

    Args:
        steps, particles: of the optimisation. draws: to evaluate both guides with the same noise.
    """
    if not subject.codes:
        return without_codes(NAME, TITLE)
    model, guide = subject.model, subject.guide
    window = some_windows(subject.validation, windows, subject.seed)
    with seeded(subject.seed):
        refined = refine(model, guide, window, steps=steps, particles=particles)
    logs = []
    for program in (guide, refined):
        with seeded(subject.seed + 1):
            logs.append(log_weights(model, program, window, draws))
    gap = logs[1].mean(0) - logs[0].mean(0)
    bounds = [evidence_bounds(log, [draws])[draws] for log in logs]
    left = bounds[1] - logs[1].mean(0)
    tails = [(pareto_shapes(log) > UNRELIABLE).double().mean().item() for log in logs]
    values: dict[str, Any] = {
        "windows": len(gap),
        "elbo": mean_with_error(logs[0].mean(0)),
        "refined_elbo": mean_with_error(logs[1].mean(0)),
        "gap": mean_with_error(gap),
        "gap_median": gap.median().item(),
        "approximation_gap": mean_with_error(left),
        "pareto_k_above_0.7": {"guide": tails[0], "refined": tails[1]},
        "bound_gained": mean_with_error(bounds[1] - bounds[0]),
    }
    explanation = (
        f"Each of {len(gap)} validation windows gets a shift and a stretch of its own for every dimension of its "
        f"codes, on top of the guide, by {steps} steps of Adam on the same ELBO. What this gains is the amortisation "
        f"gap; what the bound of {draws} particles of the refined guide still lies above its ELBO is (at least) the "
        "approximation gap."
    )
    return Section(
        NAME, TITLE, explanation, _findings(values), values, [_table(values, steps, draws)], [_draw(gap, left)]
    )


def _findings(values: dict[str, Any]) -> list[str]:
    gap, left, tails = values["gap"], values["approximation_gap"], values["pareto_k_above_0.7"]
    share = gap["mean"] / max(gap["mean"] + left["mean"], 1e-12)
    return [
        f"Refining the guide for each window gains {gap['mean']:.2f} ± {gap['standard_error']:.2f} nats (median "
        f"{values['gap_median']:.2f}); at least {left['mean']:.2f} ± {left['standard_error']:.2f} nats are left to the "
        "shape of the guide.",
        f"So {min(max(share, 0.0), 1.0):.0%} of the known error of the guide is its network's, and the rest its "
        f"family's. k-hat is above {UNRELIABLE} for {tails['guide']:.0%} of the windows before and "
        f"{tails['refined']:.0%} after.",
    ]


def _table(values: dict[str, Any], steps: int, draws: int) -> Table:
    names = {
        "elbo": "ELBO of the guide",
        "refined_elbo": f"ELBO after {steps} steps for each window",
        "gap": "amortisation gap",
        "approximation_gap": "approximation gap (at least)",
        "bound_gained": f"gain of the bound of {draws} particles",
    }
    rows = [[label, values[key]["mean"], values[key]["standard_error"]] for key, label in names.items()]
    return Table(["nats per window", "mean", "standard error"], rows, digits=2)


def _draw(gap: Tensor, left: Tensor) -> Picture:
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    panel = figure.subplots()
    # The few windows with huge gaps would leave one bar for all others.
    end = torch.cat((gap, left)).quantile(0.95).item()
    edges = torch.linspace(min(0.0, gap.min().item(), left.min().item()), max(end, 1e-3), 31).tolist()
    for name, values, color in (("amortisation", gap, "#0072B2"), ("approximation (at least)", left, "#D55E00")):
        panel.hist(values.clamp(max=edges[-1]).numpy(), edges, histtype="step", linewidth=1.6, color=color, label=name)
        panel.axvline(values.mean().item(), color=color, linestyle="--", linewidth=1.0)
    panel.set(xlabel="gap (nats)", ylabel="windows")
    panel.legend(fontsize=9, frameon=False)
    panel.spines[["top", "right"]].set_visible(False)
    caption = "Gaps of single windows, with their means (dashed). The last bar holds all larger ones."
    return Picture("amortisation_gap", caption, figure)
