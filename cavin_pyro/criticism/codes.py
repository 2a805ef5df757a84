"""Samples of codes and their importance weights, for any model and guide, from Pyro's traces."""

from __future__ import annotations

import pyro
import torch
from pyro import poutine
from torch import Tensor

from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.windows import batches, seeded
from cavin_pyro.models.state import Window
from cavin_pyro.training.elbo import Program, latent_sites, substitute, window_terms

NO_CODES = "The model has no codes, so there is nothing to check here."
SYMBOLS = {"effect_code": "c", "motion_code": "z"}  # the paper's symbols
Codes = dict[str, Tensor]


@torch.no_grad()
def log_weights(model: Program, guide: Program, window: Window, particles: int) -> Tensor:
    """Logarithms of p(observed, codes) / q(codes) for K samples of each window `[B]`: `[K, B]` float64, in nats."""
    pieces = []
    for some in batches(particles, window):
        terms = window_terms(model, guide, window, particles=some.stop - some.start)
        pieces.append(-torch.stack([term.double() for term in terms.values()]).sum(0))
    return torch.cat(pieces)


@torch.no_grad()
def sample_guide(guide: Program, window: Window, samples: int) -> Codes:
    """Codes `[samples, B, D]` of each window `[B]` from the guide; from the prior, if the model takes its place."""
    pieces: dict[str, list[Tensor]] = {}
    for some in batches(samples, window):
        with pyro.plate("particles", some.stop - some.start, dim=-2):
            trace = poutine.trace(guide).get_trace(window)
        for name, site in latent_sites(trace).items():
            pieces.setdefault(name, []).append(site["value"])
    return {name: torch.cat(values) for name, values in pieces.items()}


@torch.no_grad()
def guide_density(guide: Program, window: Window, values: Codes, site: str) -> Tensor:
    """log q(value | window) at one site for `values: [K, B, D]` of all sites: `[K, B]` float64."""
    pieces = []
    for some in batches(len(values[site]), window):
        here = {name: value[some] for name, value in values.items()}
        with pyro.plate("particles", len(here[site]), dim=-2):
            trace = poutine.trace(substitute(guide, here)).get_trace(window)
        trace.compute_log_prob(site_filter=lambda name, _: name == site)
        pieces.append(trace.nodes[site]["log_prob"].double())
    return torch.cat(pieces)


def unsuitable_codes(context: CheckContext, window: Window) -> str:
    """Why a check of codes does not apply to a model: it has none, or some are no vectors of numbers; else empty."""
    if not context.codes:
        return NO_CODES
    with seeded(context.seed):
        sampled = sample_guide(context.guide, window.map(lambda field: field[:2]), 1)
    names = [name for name, value in sampled.items() if not value.is_floating_point() or value.dim() != 3]
    names += [name for name in context.codes if name not in sampled]
    return f"{', '.join(names)}: this check is of codes that the guide samples as vectors of numbers." if names else ""
