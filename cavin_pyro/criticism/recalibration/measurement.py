"""What calibration changes: coverage of codes by simulation, and the ELBO and decoded subgoals on real windows."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch

from cavin_pyro.criticism.checks.simulation import ACTIVE_CONTRACTION
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.statistics.clusters import mean_interval
from cavin_pyro.criticism.statistics.codes import SYMBOLS
from cavin_pyro.criticism.statistics.elbo import TOTAL, terms_by_window
from cavin_pyro.criticism.statistics.inference.simulation import calibrate, coverage, joint_coverage, simulate
from cavin_pyro.criticism.statistics.intervals import as_percent
from cavin_pyro.criticism.statistics.predictions import (
    has_subgoals,
    predict_subgoals,
    probability_integral_transform,
)
from cavin_pyro.criticism.statistics.windows import from_same_starts, seeded

LEVEL = 0.9
BATCH = 500  # windows
PARTICLES = 4  # of the ELBO
DECODED = 20  # samples of h

Measured = dict[str, Any]


@torch.no_grad()
def measure_guide(context: CheckContext, *, windows: int, samples: int, repeats: int = 1) -> Measured:
    """Means with 95 % intervals over episodes, on held-out windows, with the same random numbers for every guide.

    Args:
        windows: at most so many, and their first states for simulation. samples: of the guide for each.
        repeats: windows that are simulated from each first state.

    Returns:
        `windows`, `simulated`, `episodes`; of simulated windows the coverage of 90 % intervals, by code: `coverage`
        over all dimensions, `coverage_informed` over those that learn from the window (`informed` of `dimensions`),
        `coverage_worst` in the dimension of least coverage, and `joint`, of the region of highest density. Of real
        windows `minus_elbo`, in nats, and `subgoal_coverage`, of the centres that moved by 90 % intervals of h's
        predictions with codes of the guide; None without h, or if nothing moved.
    """
    window, episodes = context.held_out(windows)
    first, simulated_from = from_same_starts(window, episodes, repeats)
    with seeded(context.seed):
        codes, simulated = simulate(context.model, first)
        found = calibrate(context.model, context.guide, codes, simulated, samples=samples)
    by_code = {}
    for name, ranks in found.ranks.items():
        informed = found.contraction[name] > ACTIVE_CONTRACTION
        each = [coverage(column, LEVEL, simulated_from) for column in ranks.T]
        by_code[SYMBOLS[name]] = {
            "coverage": coverage(ranks, LEVEL, simulated_from)._asdict(),
            "coverage_informed": coverage(
                ranks[:, informed] if informed.any() else ranks, LEVEL, simulated_from
            )._asdict(),
            "coverage_worst": min(each, key=lambda one: one.mean)._asdict(),
            "informed": int(informed.sum()),
            "dimensions": ranks.shape[1],
            "contraction": found.contraction[name].max().item(),
            "spread": found.spread[name].max().item(),
        }
    with seeded(context.seed):
        terms = terms_by_window(context.model, context.guide, window, PARTICLES, BATCH)
        decoded = None
        if has_subgoals(context.model, window):
            prediction = predict_subgoals(context.model, window, DECODED, guide=context.guide)
            pit = probability_integral_transform(prediction.centers, prediction.real_centers)
            inside = ((pit - 0.5).abs() <= LEVEL / 2).double().mean(-1)
            share = (inside * prediction.moved).sum(-1) / prediction.moved.sum(-1)  # NaN where nothing moved
            decoded = mean_interval(share, episodes)._asdict() if prediction.moved.any() else None
    return {
        "windows": len(episodes),
        "simulated": len(simulated_from),
        "episodes": len(episodes.unique()),
        "codes": by_code,
        "joint": joint_coverage(found.joint, LEVEL, simulated_from)._asdict(),
        "minus_elbo": mean_interval(terms[TOTAL], episodes)._asdict(),
        "subgoal_coverage": decoded,
    }


def sentences(before: Measured, after: Measured) -> list[str]:
    """Both measurements, side by side, for the terminal."""
    percent = partial(as_percent, digits=1)
    lines = []
    for symbol, code in before["codes"].items():
        now = after["codes"][symbol]
        lines += [
            f"90 % intervals of {symbol} cover {percent(code['coverage'])}, now {percent(now['coverage'])}; of "
            f"informed dimensions ({code['informed']}, now {now['informed']}) {percent(code['coverage_informed'])}, "
            f"now {percent(now['coverage_informed'])}; of the worst dimension {percent(code['coverage_worst'])}, "
            f"now {percent(now['coverage_worst'])}"
        ]
    lines.append(f"90 % regions of all codes cover {percent(before['joint'])}, now {percent(after['joint'])}")
    elbo, now = (one["minus_elbo"]["mean"] for one in (before, after))
    lines.append(f"real windows: -ELBO {elbo:.2f} nats, now {now:.2f}")
    if before["subgoal_coverage"]:
        lines.append(
            f"real windows: 90 % intervals of h's centres that moved cover {percent(before['subgoal_coverage'])}, "
            f"now {percent(after['subgoal_coverage'])}"
        )
    return lines
