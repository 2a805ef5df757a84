"""(s, c, z) as one row of numbers, for the classifier and the tests that it feeds."""

from __future__ import annotations

from typing import Any

import torch
from pyro import poutine
from torch import Tensor

from cavin_pyro.criticism.statistics.codes import Codes
from cavin_pyro.criticism.statistics.pushing import pair_distances, path_distances, start_distances
from cavin_pyro.criticism.statistics.windows import Outcome, generated
from cavin_pyro.training.elbo import Program, substitute
from models.model import Model
from models.state import State, Window

FAR = 0.3  # metres; distances that are larger (or infinite) count as this
OBJECT_FEATURES = 8  # numbers of the mean geometric feature that are kept


@torch.no_grad()
def describe(model: Program, window: Window, codes: Codes) -> Tensor:
    """Rows `[B, P]` of the first states of windows `[B]` with codes `[B, D]`: the state, the codes, and what they mean.

    All columns are functions of (s, c, z), so that a test of rows is a test of (s, c, z) jointly: the state's moments;
    the codes; their standardised residuals and log densities under the model's own prior; and, for our models, the
    subgoal, the pushes and the distances between pushes and objects.
    """
    columns = [state_summary(window.first), *codes.values(), prior_residuals(model, window, codes)]
    if isinstance(model, Model):
        columns.append(decoded_summary(decode(model, window, codes)))
    return torch.cat([column.float() for column in columns], -1)


def decode(model: Model, window: Window, codes: Codes) -> Outcome:
    """What codes `[B, D]` mean at the first states of windows `[B]`: means of h, g and f."""
    return generated(model, window, codes=codes, means=tuple(codes))


def state_summary(state: State) -> Tensor:
    """Number of objects, mean and spread of their centres, and some of their mean feature: `[B, 7 + 8]`."""
    real = state.mask.unsqueeze(-1)
    count = real.sum(-2).clamp(min=1)
    mean = (state.centers * real).sum(-2) / count
    spread = (((state.centers - mean.unsqueeze(-2)) * real).square().sum(-2) / count).sqrt()
    features = (state.features * real).sum(-2) / count
    return torch.cat((count.to(mean), mean, spread, features[..., :OBJECT_FEATURES]), -1)


def prior_residuals(model: Program, window: Window, codes: Codes) -> Tensor:
    """Codes `[B, D]` standardised by their prior, where it is Gaussian, and the log density of each code: `[B, R]`."""
    trace = poutine.trace(substitute(model, codes)).get_trace(window)
    trace.compute_log_prob(site_filter=lambda name, _: name in codes)
    columns = []
    for name, value in codes.items():
        site: Any = trace.nodes[name]
        columns.append(site["log_prob"].unsqueeze(-1))
        normal = getattr(site["fn"], "base_dist", site["fn"])
        if isinstance(normal, torch.distributions.Normal):
            columns.append((value - normal.loc) / normal.scale)
    return torch.cat(columns, -1)


def decoded_summary(outcome: Outcome) -> Tensor:
    """Pushes, how near they come to objects, and how the subgoal moves what: `[B, R]`."""
    centers, mask = outcome.first.centers, outcome.first.mask
    columns = []
    if outcome.chosen:
        nearest = path_distances(outcome).amin(-1)
        columns += [outcome.actions.flatten(-2), nearest, start_distances(outcome).amin(-1)]
    if outcome.subgoal is not None:
        change = (outcome.subgoal - centers) * mask.unsqueeze(-1)
        moves = change.norm(dim=-1)
        columns += [change.sum(-2), moves.amax(-1, True), moves.sum(-1, True)]
        columns.append(pair_distances(outcome.subgoal, mask).amin((-2, -1)).unsqueeze(-1))
        if outcome.chosen:  # whether the first push goes for what the subgoal moves
            target = moves.argmax(-1, keepdim=True)
            columns.append(path_distances(outcome)[:, 0].gather(-1, target))
            columns.append(start_distances(outcome)[:, 0].gather(-1, target))
    ends = outcome.steps[:, -1] - centers
    columns.append((ends * mask.unsqueeze(-1)).norm(dim=-1).amax(-1, True))
    return torch.cat([column.clamp(max=FAR) for column in columns], -1)
