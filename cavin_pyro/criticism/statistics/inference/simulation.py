"""Simulation-based calibration of a guide: codes from the prior, windows from the program, codes from the guide.

Talts, Betancourt, Simpson, Vehtari and Gelman, "Validating Bayesian inference algorithms with simulation-based
calibration", 2018. On average, posterior intervals of a simulated window must cover its own code at their
nominal rate.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from pyro import poutine
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from cavin_pyro.criticism.statistics.clusters import Interval, mean_interval
from cavin_pyro.criticism.statistics.codes import Codes, guide_density, log_weights, sample_guide
from cavin_pyro.criticism.statistics.inference.information import SAME
from cavin_pyro.criticism.statistics.predictions import probability_integral_transform
from cavin_pyro.training.elbo import Program, window_terms
from models.networks.layers import unit
from models.state import State, Window

LEVELS = (0.5, 0.9)  # of central intervals, and of the joint region of highest density


@torch.no_grad()
def simulate(model: Program, window: Window, *, noise_in_features: bool = True) -> tuple[Codes, Window]:
    """Codes `[B, D]` from the prior and windows from the program, from the first states of windows `[B]`.

    The last state is h's, which the guide reads, where the model has one; those between are f's.

    Args:
        noise_in_features: whether h's features are sampled, as the program says, or its means of unit length.
    """
    nodes: Any = poutine.trace(model).get_trace(window, generate=True).nodes
    names = [name for name in ("effect_code", "motion_code") if name in nodes]
    centers, features = nodes["next_centers"]["value"].clone(), unit(nodes["next_features"]["value"])
    if "subgoal_centers" in nodes:
        centers[:, -1] = nodes["subgoal_centers"]["value"]
        sampled, mean = nodes["subgoal_features"]["value"], nodes["subgoal_features"]["fn"].mean
        features[:, -1] = sampled if noise_in_features else unit(mean)
    first = window.first
    mask = first.mask.unsqueeze(1).expand(-1, centers.shape[1] + 1, -1)
    states = State(
        torch.cat((first.centers.unsqueeze(1), centers), 1), torch.cat((first.features.unsqueeze(1), features), 1), mask
    )
    actions = nodes["actions"]["value"] if "actions" in nodes else window.actions
    seen = torch.ones_like(window.transition_mask)
    simulated = Window(states, actions, seen, seen[:, 0].clone())
    return {name: nodes[name]["value"] for name in names}, simulated


class Calibration(NamedTuple):
    """Of simulated windows `[B]`."""

    ranks: Codes  # by code, [B, D] in [0, 1]: uniform if the guide is the posterior
    joint: Tensor  # [B] in [0, 1]: share of the guide's samples of all codes that are more dense than the true codes
    contraction: dict[str, Tensor]  # by code, [D]: 1 - variance of the posterior over that of the prior given s
    spread: dict[str, Tensor]  # by code, [D]: root of the mean squared z-score of the truth; 1 if right


@torch.no_grad()
def calibrate(
    model: Program, guide: Program, codes: Codes, window: Window, *, samples: int, prior_samples: int = 32
) -> Calibration:
    """Where the true codes `[B, D]` of simulated windows lie among `samples` of the guide."""
    inferred = sample_guide(guide, window, samples)
    prior = sample_guide(model, window, prior_samples)
    ranks = {name: probability_integral_transform(inferred[name], codes[name]) for name in codes}
    truth = {name: value.unsqueeze(0) for name, value in codes.items()}
    densities = [
        torch.stack([guide_density(guide, window, values, name) for name in codes]).sum(0)
        for values in (inferred, truth)
    ]
    joint = ((densities[0] > densities[1]).sum(0) + torch.rand(len(window.actions))) / (samples + 1)
    contraction, spread = {}, {}
    for name, value in codes.items():
        variance = inferred[name].var(0)
        contraction[name] = 1 - variance.mean(0) / prior[name].var(0).mean(0)
        spread[name] = ((value - inferred[name].mean(0)).square() / variance).mean(0).sqrt()
    return Calibration(ranks, joint, contraction, spread)


def coverage(ranks: Tensor, level: float, episodes: Tensor) -> Interval:
    """Coverage of central intervals of a level, by ranks `[B, D]` or `[B]`: the mean over dimensions."""
    inside = ((ranks - 0.5).abs() <= level / 2).double()
    return mean_interval(inside.flatten(1).mean(1) if inside.dim() > 1 else inside, episodes)


def joint_coverage(joint: Tensor, level: float, episodes: Tensor) -> Interval:
    """Coverage of the region of highest density of a level, by `Calibration.joint`."""
    return mean_interval((joint <= level).double(), episodes)


class Sandwich(NamedTuple):
    """Bounds in nats on the information between a code and what it explains, given all before it, in the model."""

    low: Interval | None  # None where the guide reads more than this code explains, so that nothing bounds it
    high: Interval


@torch.no_grad()
def simulated_information(
    model: Program, guide: Program, codes: Codes, window: Window, site: str, episodes: Tensor, *, particles: int
) -> Sandwich:
    """I(c; s'|s) and I(z; a|s, c) of the model's own joint, from simulated windows `[B]` and their codes `[B, D]`.

    I = E log p(x | s, c) - log p(x | s). The bound of K importance samples is below the evidence, and so gives an upper
    bound on I. With the window's own code, which is an exact sample of the posterior, as one of the K it is above the
    evidence (Sobolev and Vetrov, 2019, after Grosse and others' bidirectional Monte Carlo), and gives a lower bound; 0
    is one too, and stands in its place where a bad guide makes it fall below.
    """
    explained, others = _explained(model, window, site)
    fixed = {name: value for name, value in codes.items() if name != site}
    logs = log_weights(model, guide, window, particles, fixed=fixed, excluded=others)
    own = log_weights(model, guide, window, 1, fixed=codes, excluded=others)
    terms = window_terms(model, guide, window, particles=1, fixed=codes)
    likelihood = -torch.stack([terms[f"nll_{name}"][0].double() for name in explained]).sum(0)
    count = torch.tensor(float(particles), dtype=torch.float64).log()
    above = likelihood - (logs.logsumexp(0) - count)
    below = likelihood - (torch.cat((own, logs[1:])).logsumexp(0) - count)
    foreign = "actions" not in explained and _reads_actions(guide, codes, window, site)
    low = Interval(*(max(0.0, end) for end in mean_interval(below, episodes)))
    return Sandwich(None if foreign else low, mean_interval(above, episodes))


def _explained(model: Program, window: Window, site: str) -> tuple[list[str], list[str]]:
    """Observed sites of h and g between a code and the next code, and all other sites but the code."""
    nodes: Any = poutine.trace(model).get_trace(window).nodes
    names = [name for name, node in nodes.items() if node["type"] == "sample" and not site_is_subsample(node)]
    after = names[names.index(site) + 1 :]
    stop = next((number for number, name in enumerate(after) if not nodes[name]["is_observed"]), len(after))
    explained = [name for name in after[:stop] if not name.startswith("next_")]
    return explained, [name for name in names if name not in (*explained, site)]


def _reads_actions(guide: Program, codes: Codes, window: Window, site: str) -> bool:
    """Whether the guide's density of a code depends on the pushes."""
    values = {name: value.unsqueeze(0) for name, value in codes.items()}
    other = window._replace(actions=window.actions.flip(0))
    own, foreign = (guide_density(guide, one, values, site) for one in (window, other))
    return not torch.allclose(own, foreign, rtol=SAME, atol=SAME)
