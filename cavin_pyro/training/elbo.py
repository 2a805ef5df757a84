"""The evidence lower bound, term by term."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from typing import Any

import pyro
import torch
from pyro import poutine
from pyro.distributions.util import scale_and_mask
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from cavin_pyro.models.state import Window

EFFECT_AND_MOTION_SITES = ("subgoal_centers", "subgoal_features", "actions", "effect_code", "motion_code")
Sites = dict[str, Any]  # of a trace: dictionaries of Pyro's, by name
Program = Callable[..., Any]  # a Pyro program, or one with a handler around it; called with a window


def window_terms(model: Program, guide: Program, window: Window, *, particles: int | None = None) -> dict[str, Tensor]:
    """Each term of -ELBO for each window of a batch [B], from one sample of the codes, or from K.

    The sum over terms is minus the logarithm of the sample's importance weight. Sites of the model that the guide lacks
    and that are marked `infer={"enumerate": "parallel"}` are summed out: each other term is its mean over their
    posterior given the sample, and theirs is the divergence of that from their prior.

    Args:
        particles: K, an outermost plate of independent samples; the programs must broadcast over it.

    Returns `nll_<site>` for observed sites and `kl_<site>` (a one-sample estimate) for codes: `[B]` or `[K, B]`. An
    automatic guide of Pyro's has its density at auxiliary sites, each a term `kl_<site>` more: `[]` if one density is
    that of all windows.
    """
    with pyro.plate("particles", particles, dim=-2) if particles else nullcontext():
        guided = poutine.trace(guide).get_trace(window)
        replayed = poutine.enum(poutine.replay(model, trace=guided), first_available_dim=-3 if particles else -2)
        joint = poutine.trace(replayed).get_trace(window)
    guided.compute_log_prob()
    joint.compute_log_prob()
    sites, samples_of_guide = sampled_sites(joint), sampled_sites(guided)
    expectation, divergences = sum_out(sites)
    terms = {}
    for name, site in sites.items():
        if name in divergences:
            terms[f"kl_{name}"] = divergences[name]
        elif site["is_observed"]:
            terms[f"nll_{name}"] = -expectation(site["log_prob"])
        else:
            terms[f"kl_{name}"] = samples_of_guide[name]["log_prob"] - expectation(site["log_prob"])
    return terms | {f"kl_{name}": site["log_prob"] for name, site in samples_of_guide.items() if name not in sites}


def sampled_sites(trace: poutine.Trace) -> Sites:
    """Sampled and observed sites by name, without plates, which are sites of a trace too."""
    return {
        name: site for name, site in trace.nodes.items() if site["type"] == "sample" and not site_is_subsample(site)
    }


def latent_sites(trace: poutine.Trace) -> Sites:
    """Sampled sites by name, without those that are observed."""
    return {name: site for name, site in sampled_sites(trace).items() if not site["is_observed"]}


def sum_out(sites: Sites) -> tuple[Callable[[Tensor], Tensor], dict[str, Tensor]]:
    """Sums enumerated sites out of the model's `sites`, whose log densities are computed.

    Returns the expectation of a log density over their exact posterior, and by site the divergence of that from its
    prior. Without such sites the expectation is the identity.
    """
    dims = {name: site["infer"]["_enumerate_dim"] for name, site in sites.items() if "_enumerate_dim" in site["infer"]}
    if not dims:
        return lambda log_density: log_density, {}
    every = tuple(dims.values())  # -2, -3, ... or, beside particles, -3, -4, ...
    densities = [site["log_prob"] for site in sites.values() if site["log_prob"].dim() >= -every[0]]
    joint = sum(densities, torch.zeros(()))
    posterior = (joint - joint.logsumexp(every, keepdim=True)).detach()
    weights = posterior.exp()

    def expectation(log_density: Tensor) -> Tensor:
        if log_density.dim() < -every[0]:
            return log_density
        return (weights * log_density).where(weights > 0, 0.0).sum(every)

    divergences = {}
    given = torch.zeros(())
    for place, name in enumerate(dims):
        later = every[place + 1 :]
        marginal = posterior.logsumexp(later, keepdim=True) if later else posterior
        divergence = expectation(marginal - given) - expectation(sites[name]["log_prob"])
        divergences[name] = scale_and_mask(divergence, mask=sites[name]["mask"])
        given = marginal
    return expectation, divergences


def substitute(program: Program, values: Mapping[str, Tensor]) -> Program:
    """The program with these values at these latent sites, in place of samples."""
    trace = poutine.Trace()
    for name, value in values.items():
        trace.add_node(name, name=name, type="sample", is_observed=False, value=value, infer={})
    return poutine.replay(program, trace=trace) if values else program


def elbo_terms(model: Program, guide: Program, window: Window) -> dict[str, Tensor]:
    """Each term of the loss -ELBO for a batch [B], from one sample of the codes; their sum is Trace_ELBO's loss.

    Returns the terms of `window_terms`: scalars, summed over windows.
    """
    return {name: term.sum() for name, term in window_terms(model, guide, window).items()}


def term_counts(names: Iterable[str], window: Window) -> dict[str, int]:
    """How many windows of a batch [B], or how many of their transitions, count for each of these terms."""
    sequences, transitions = int(window.sequence_mask.sum()), int(window.transition_mask.sum())
    return {
        name: sequences if name.startswith("kl_") or name.partition("_")[2] in EFFECT_AND_MOTION_SITES else transitions
        for name in names
    }


def first_nonfinite(terms: Mapping[str, Tensor | float]) -> str | None:
    """Name of the first term, a scalar, that is not finite."""
    return next((name for name, value in terms.items() if not torch.as_tensor(value).isfinite()), None)
