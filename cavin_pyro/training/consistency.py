"""How likely the motions of the prior reach the subgoal: a term of the objective beside the bound.

The paper asserts that the pushes of (s, c, z) lead to h(s, c), and nothing in the bound says so: it fits p(z | s, c) to
motions that led to s', with a spread that covers what lies between them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cavin_pyro.training.sampled_effects import sample, sample_effects
from models.model import Model
from models.state import State, Window
from planning.rollouts.dynamics import predict_states

SCALE = 0.02  # metres, in x and in y: how near to its place in the subgoal an object must come
LEAST = math.exp(-8.0)  # of the density, as for one object 8 cm away: a motion that goes elsewhere says nothing more


def consistency_loss(model: Model, window: Window, *, motions: int = 32, windows: int = 32) -> Tensor:
    """Minus the logarithm of the probability that a sampled motion reaches a sampled subgoal, a scalar.

    c ~ p(c | s)                                 # an effect, as a planner samples it
    z_k ~ p(z | s, c)                            # k = 1, ..., K motions
    s_k = f along the pushes of g(s, c, z_k)     # their means
    reached ~ product of N(centers of s_k; those of h(s, c), 2 cm) over the real objects, in the plane, and a constant
              as low as 8 cm away, so that windows whose motions all go elsewhere do not outweigh the others

    and the term is -log of the mean over k of the density of `reached` over its largest value: 0 if all motions reach
    the subgoal. For K motions it is an upper bound of that of all. Its gradient reaches p(z | s, c) alone, as the
    sum over k of w_k grad log p(z_k | s, c), where w_k are the normalised densities (Bornschein and Bengio 2015,
    "Reweighted wake-sleep"): no gradient passes through f, whose errors it would exploit.

    Args:
        window: `[B]`, whose first states are read. motions: K. windows: how many of the B are taken, the first; their
            sum is scaled up to B.
    """
    here, effect_code = sample_effects(model, window, windows)
    count = len(here.mask)
    with torch.no_grad():
        subgoal = model.subgoal(here, effect_code)
    prior = model.motion_prior(here, effect_code).expand((count, motions))
    with torch.no_grad():
        motion_code = sample(prior)
        pushes = model.actions(here, effect_code=effect_code.expand(-1, motions, -1), motion_code=motion_code)
        ends, _ = predict_states(model, here, pushes)
        density = _log_density(ends, subgoal)
    log_prior = prior.log_prob(motion_code)
    # The second factor is 1: it only has the gradient of the prior's density.
    each = (density + log_prior - log_prior.detach()).logsumexp(-1) - math.log(motions)
    return -each.sum() * (len(window.sequence_mask) / count)


def _log_density(end: State, subgoal: State) -> Tensor:
    """Logarithm of the density of `reached` over its largest value: `[b, K]`."""
    squared = (end.centers - subgoal.centers)[..., :2].square().sum(-1)
    density = (-torch.where(subgoal.mask, squared, 0.0).sum(-1) / (2.0 * SCALE**2)).exp()
    return ((density + LEAST) / (1.0 + LEAST)).log()
