"""How well a model predicts each held-out window, in numbers that compare between models."""

from __future__ import annotations

from typing import Any

import torch
from pyro import poutine
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.statistics.clusters import Interval
from cavin_pyro.criticism.statistics.codes import log_weights, sample_prior
from cavin_pyro.criticism.statistics.inference.importance import evidence_bounds
from cavin_pyro.criticism.statistics.predictions import energy_score, has_subgoals, predict_subgoals
from cavin_pyro.criticism.statistics.prior.decoded import decoded_statistics
from cavin_pyro.criticism.statistics.prior.features import decode
from cavin_pyro.criticism.statistics.pushing import MOVED, Nearness
from cavin_pyro.criticism.statistics.windows import observed
from cavin_pyro.training.elbo import window_terms
from models.state import Window

FEATURES = ("next_features", "subgoal_features")
# name -> what it is, and 1 where more is better, -1 where less is
LABELS = {
    "log_next": ("f: log density of the next states (nats)", 1),
    "log_window": ("bound on log p({sites} | s) (nats)", 1),
    "error_f": ("f: error of objects that moved (m)", -1),
    "energy_h": ("h, codes from the prior: energy score (m)", -1),
    "first_push_near": ("first pushes, codes from the prior, that pass near an object (share)", 1),
}
Scores = dict[str, Tensor]


def explained_sites(context: CheckContext, window: Window) -> tuple[str, ...]:
    """Observed sites of the program but those of f."""
    nodes = poutine.trace(context.model).get_trace(window).nodes
    seen = [name for name, node in nodes.items() if node["type"] == "sample" and not site_is_subsample(node)]
    return tuple(name for name in seen if nodes[name]["is_observed"] and not name.startswith("next_"))


@torch.no_grad()
def window_scores(
    context: CheckContext, window: Window, *, sites: tuple[str, ...], excluded: tuple[str, ...], samples: int
) -> Scores:
    """Each of `LABELS` that the model has, for windows `[B]`: `[B]`, NaN where there is none.

    Args:
        sites: the log density of these is bounded, by `samples` particles; () leaves it out. excluded: sites that count
            nowhere, because they are of other numbers in another model.
    """
    model, guide = context.model, context.guide
    terms = window_terms(model, guide, window, particles=1)
    following = [
        -terms[f"nll_{name}"][0].double() for name in ("next_centers", "next_features") if name not in excluded
    ]
    found = {"log_next": torch.stack(following).sum(0)}
    if context.codes and sites:
        others = ["next_centers", "next_features", *excluded]
        found["log_window"] = evidence_bounds(log_weights(model, guide, window, samples, excluded=others), [samples])[
            samples
        ]
    found["error_f"] = _error(context, window)
    if has_subgoals(model, window):
        prediction = predict_subgoals(model, window, samples)
        found["energy_h"] = energy_score(prediction.centers, prediction.real_centers, prediction.counted).double()
    if context.codes:
        outcome = decode(model, window, sample_prior(model, window))
        found["first_push_near"] = decoded_statistics(outcome, Nearness.of(observed(window)))["first_push_near"]
    return found


def _error(context: CheckContext, window: Window) -> Tensor:
    """Mean distance of f's centres from the real ones, of objects that a push moved: `[B]` metres."""
    states = window.states
    before, after = states.step(slice(0, -1)), states.step(slice(1, None))
    counted = before.mask & after.mask & window.transition_mask.unsqueeze(-1)
    counted &= (after.centers - before.centers).norm(dim=-1) > MOVED
    nodes: Any = poutine.trace(context.model).get_trace(window).nodes
    mean = nodes["next_centers"]["fn"].mean
    distance = (mean - after.centers).norm(dim=-1)
    number = counted.sum((-2, -1))
    return ((distance * counted).sum((-2, -1)) / number.clamp(min=1)).double().masked_fill(number == 0, torch.nan)


def better(difference: Interval, sign: int) -> str:
    """Which of two is better, by the interval of the first less the second; `sign`: 1 where more is better."""
    if difference.low <= 0 <= difference.high or difference.low != difference.low:
        return "no difference shown"
    return "a" if (difference.mean > 0) == (sign > 0) else "b"
