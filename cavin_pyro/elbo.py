"""The evidence lower bound, term by term."""

from __future__ import annotations

import torch
from pyro import poutine
from pyro.nn import PyroModule
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from models.state import Window

EFFECT_AND_MOTION_SITES = ("subgoal_centers", "subgoal_features", "actions", "effect_code", "motion_code")


def elbo_terms(model: PyroModule, guide: PyroModule, window: Window) -> dict[str, Tensor]:
    """Each term of the loss -ELBO for a batch [B], from one draw of the codes; their sum is Trace_ELBO's loss.

    Returns:
        `nll_<site>` for observed sites and `kl_<site>` (a one-sample estimate) for codes: scalars, summed over
        windows.
    """
    guided = poutine.trace(guide).get_trace(window)
    joint = poutine.trace(poutine.replay(model, trace=guided)).get_trace(window)
    guided.compute_log_prob()
    joint.compute_log_prob()
    terms = {}
    for name, site in joint.nodes.items():
        if site["type"] != "sample" or site_is_subsample(site):
            continue
        if site["is_observed"]:
            terms[f"nll_{name}"] = -site["log_prob_sum"]
        else:
            terms[f"kl_{name}"] = guided.nodes[name]["log_prob_sum"] - site["log_prob_sum"]
    return terms


@torch.no_grad()
def mean_terms(model: PyroModule, guide: PyroModule, window: Window) -> dict[str, float]:
    """The same, each divided by the number of windows or transitions that count for it."""
    sequences = max(1, int(window.sequence_mask.sum()))
    transitions = max(1, int(window.transition_mask.sum()))
    means = {}
    for name, value in elbo_terms(model, guide, window).items():
        latent = name.partition("_")[2] in EFFECT_AND_MOTION_SITES
        means[name] = value.item() / (sequences if latent else transitions)
    return means


def first_unsound(terms: dict[str, Tensor]) -> str | None:
    """Name of the first term that is not finite."""
    return next((name for name, value in terms.items() if not bool(torch.isfinite(value).all())), None)
