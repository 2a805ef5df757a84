"""How much codes carry: nats per dimension, dimensions in use, and bounds on mutual information."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import pyro
import torch
from pyro import distributions, poutine
from torch import Tensor

from cavin_pyro.criticism.statistics.clusters import mean_with_error
from cavin_pyro.criticism.statistics.codes import Codes, guide_density
from cavin_pyro.training.elbo import Program, substitute
from models.state import Window

ACTIVE = 0.01  # variance of the posterior mean, of codes whose prior has a variance of about one


def posterior_mean_variance(samples: Tensor) -> Tensor:
    """Variance over windows of the posterior mean, of samples `[N, B, D]`: `[D]`.

    Burda et al. (2016) call a dimension active where this is above 0.01. The mean of N samples varies by itself; that
    much is taken off, so an unused dimension comes out near zero (slightly negative at times).
    """
    return samples.mean(0).var(0) - samples.var(0).mean(0) / len(samples)


@torch.no_grad()
def dimension_kl(model: Program, guide: Program, window: Window, *, samples: int = 16) -> Codes:
    """KL(q | p) of each dimension of each code and window: `[B, D]` nats by code.

    Exact given the codes before it, over which it is averaged by samples. Codes whose guide or prior is not a diagonal
    Gaussian are left out: their KL does not fall into dimensions.
    """
    with pyro.plate("particles", samples, dim=-2):
        guided = poutine.trace(guide).get_trace(window)
        joint = poutine.trace(poutine.replay(model, trace=guided)).get_trace(window)
    found = {}
    for name in joint.stochastic_nodes:
        if name in guided:
            q, p = _normal(guided.nodes[name]["fn"]), _normal(joint.nodes[name]["fn"])
            if q is not None and p is not None:
                found[name] = torch.distributions.kl_divergence(q, p).double().mean(0)
    return found


def _normal(distribution: Any) -> torch.distributions.Normal | None:
    """The Normal within a diagonal Gaussian, None for anything else."""
    if isinstance(distribution, distributions.Independent):
        distribution = distribution.base_dist
    return distribution if isinstance(distribution, torch.distributions.Normal) else None


class Information(NamedTuple):
    """Bounds in nats, from N windows."""

    lower: float  # of I(code; window) under the guide; never above log N
    upper: float  # of the same
    lower_error: float  # standard errors, clustered by episode
    upper_error: float


def mutual_information(guide: Program, window: Window, codes: Codes, site: str, episodes: Tensor) -> Information:
    """Bounds on I(code; what it is inferred from) when windows come as in the data and codes from the guide.

    E [log q(code_i | window_i) - log q(code_i)], with the aggregate posterior q(code) estimated as the mean of
    q(code_i | window_j) over the N windows: with j = i among them this is a lower bound, without it an upper bound
    (Poole et al., 2019). A later code is inferred from each window's own earlier code.

    This is I(c; s, s') and I(z; s, a, c). I(c; s'|s) is smaller by I(c; s), which cannot be estimated from data with
    one window for each state: see `conditional_bounds`.

    Args:
        codes: one sample `[B, D]` of every code. site: which one. episodes: of the windows `[B]`.
    """
    count = len(window.actions)
    # Row i: the code of window i, under every window j.
    codes_of_rows = {name: value.expand(count, *value.shape) for name, value in codes.items()}
    codes_of_rows[site] = codes[site].unsqueeze(1).expand(count, *codes[site].shape)
    densities = guide_density(guide, window, codes_of_rows, site)
    own = densities.diagonal()
    lower = own - densities.logsumexp(1) + math.log(count)
    others = densities.masked_fill(torch.eye(count, dtype=torch.bool), -math.inf).logsumexp(1)
    upper = own - others + math.log(count - 1)
    below, above = (mean_with_error(values, episodes) for values in (lower, upper))
    return Information(below["mean"], above["mean"], below["standard_error"], above["standard_error"])


SAME = 1e-6  # nats; log densities that differ by less are equal but for rounding


@torch.no_grad()
def prior_varies(model: Program, window: Window, codes: Codes, site: str) -> bool:
    """Whether the prior of a code is another one for another state or another earlier code of windows `[B]`.

    Args:
        codes: `[B, D]` of all codes.
    """
    values = {**codes, site: torch.zeros_like(codes[site])}
    trace = poutine.trace(substitute(model, values)).get_trace(window)
    trace.compute_log_prob(site_filter=lambda name, _: name == site)
    density = trace.nodes[site]["log_prob"]
    return bool(density.max() - density.min() > SAME * (1 + density.abs().max()))


class Bounds(NamedTuple):
    """Of a quantity, in nats. None: no bound is known, and so there is no number to print."""

    low: float | None
    high: float | None


def conditional_bounds(rate: float, divergence: float) -> tuple[Bounds, Bounds]:
    """Bounds on I(code; observed | s) under the guide, and on KL(aggregate posterior given s | prior given s).

    They hold for every prior. E KL(q | p) is the sum of the two, for q(c | s) = E q(c | s, s') over the s' that follow
    s: E KL(q(c|s,s') | p(c|s)) = I(c; s'|s) + E KL(q(c|s) | p(c|s)). With one window for each state neither is known:
    the rate bounds both from above, and a classifier's bound on the second makes the first bound tighter. Nothing
    but 0 bounds the information from below.

    Args:
        rate: E KL(q | p). divergence: a lower bound on the second, see `prior.classifier.divergence_bound`; below 0 it
            says nothing.
    """
    known = min(max(divergence, 0.0), rate)
    return Bounds(None, rate - known), Bounds(known, rate)


def marginal_bounds(rate: float, information: Information, *, varies: bool) -> Bounds:
    """Bounds on KL(aggregate posterior | prior), rate - I(code; s, s'), for a prior that is the same everywhere.

    Raises:
        ValueError: the prior varies, so that this difference bounds nothing.
    """
    if varies:
        raise ValueError(
            "rate - I(code; s, s') bounds no divergence when the prior depends on the state: see conditional_bounds"
        )
    return Bounds(rate - min(information.upper, rate), rate - information.lower)
