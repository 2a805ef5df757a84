"""The evidence lower bound, term by term."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from typing import Any

import pyro
import torch
from pyro import poutine
from pyro.nn import PyroModule
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from models.state import Window

EFFECT_AND_MOTION_SITES = ("subgoal_centers", "subgoal_features", "actions", "effect_code", "motion_code")
Program = Callable[..., Any]  # a Pyro program, or one with a handler around it; called with a window


def window_terms(
    model: Program,
    guide: Program,
    window: Window,
    *,
    particles: int | None = None,
    held: Mapping[str, Tensor] | None = None,
) -> dict[str, Tensor]:
    """Each term of -ELBO for each window of a batch [B], from one draw of the codes, or from K draws.

    The sum over terms is minus the logarithm of the importance weight of the draw.

    Args:
        particles: K, an outermost plate of independent draws; the programs must broadcast over it.
        held: values of codes, `[B, D]` or `[K, B, D]`, that are taken instead of draws from the guide. Their terms
            are still the guide's and the model's densities at these values.

    Returns:
        `nll_<site>` for observed sites and `kl_<site>` (a one-sample estimate) for codes: `[B]` or `[K, B]`.
    """
    with pyro.plate("particles", particles, dim=-2) if particles else nullcontext():
        guided = poutine.trace(hold(guide, held or {})).get_trace(window)
        joint = poutine.trace(poutine.replay(model, trace=guided)).get_trace(window)
    guided.compute_log_prob()
    joint.compute_log_prob()
    terms = {}
    for name, site in joint.nodes.items():
        if site["type"] != "sample" or site_is_subsample(site):
            continue
        if site["is_observed"]:
            terms[f"nll_{name}"] = -site["log_prob"]
        else:
            terms[f"kl_{name}"] = guided.nodes[name]["log_prob"] - site["log_prob"]
    return terms


def hold(program: Program, values: Mapping[str, Tensor]) -> Program:
    """A program that takes these values at these sites, as if it had drawn them."""
    held = poutine.Trace()
    for name, value in values.items():
        held.add_node(name, name=name, type="sample", is_observed=False, value=value, infer={})
    return poutine.replay(program, trace=held) if values else program


def elbo_terms(model: PyroModule, guide: PyroModule, window: Window) -> dict[str, Tensor]:
    """Each term of the loss -ELBO for a batch [B], from one draw of the codes; their sum is Trace_ELBO's loss.

    Returns:
        The terms of `window_terms`: scalars, summed over windows.
    """
    return {name: term.sum() for name, term in window_terms(model, guide, window).items()}


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
