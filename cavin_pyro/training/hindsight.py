"""How far subgoals lie from what motions attain: a term of the objective beside the bound.

The bound fits h(s' | s, c) to codes that the guide infers from what happened. Codes of the prior need not be among
them, and for those h may promise what no motion of p(z | s, c) brings about. A planner then chooses what h promises
most. In hindsight the subgoal of such a code is what came of it (Levy et al., ICLR 2019, "Learning Multi-Level
Hierarchies with Hindsight", relabel subgoals so).
"""

from __future__ import annotations

import torch
from torch import Tensor

from cavin_pyro.training.rollout import distance_in_units
from cavin_pyro.training.sampled_effects import sample, sample_effects
from models.model import Model
from models.state import Window
from planning.rollouts.dynamics import sample_states

OUTCOMES = 4  # samples of f for each motion, to choose one, and as many others for what it attains


def hindsight_loss(model: Model, window: Window, reference: Model, *, motions: int = 64, windows: int = 16) -> Tensor:
    """The distance between h's subgoals and what the motions that a planner would choose for them attain, a scalar.

    c ~ p(c | s)                                     # an effect, as a planner samples it
    z_k ~ p(z | s, c)                                # k = 1, ..., K motions
    s_k,i ~ f along the pushes of g(s, c, z_k)       # i = 1, ..., 4 outcomes, the same random numbers for all k
    k* = argmin over k of the mean over i of |centers of s_k,i - those of h0(s, c)|, summed over objects
    s*_i ~ f along the pushes of g(s, c, z_k*)       # 4 new outcomes

    and the term is the mean over i of the sum over objects of |center of h(s, c) - center of s*_i| / 5 mm +
    |feature - feature| / 0.1, the units of `rollout_loss`. Distances, not squares, because a few pushes end with an
    object that rolls away. Its gradient reaches h alone, and the state encoder that h reads; the choice and the
    outcomes have none.

    h0 is h of the `reference`, as training began: it says what an effect asks for. By h itself the choice would follow
    h, and subgoals would shrink, step by step, until nothing moves, which is attained exactly.

    Args:
        window: `[B]`, whose first states are read. reference: another copy of the model, which is not trained.
        motions: K. windows: how many of the B are taken, the first; their sum is scaled up to B.
    """
    here, effect_code = sample_effects(model, window, windows)
    count = len(here.mask)
    subgoal = model.subgoal(here, effect_code)
    with torch.no_grad():
        wanted = reference.subgoal(here, effect_code).centers
        motion_code = sample(model.motion_prior(here, effect_code).expand((count, motions)))
        pushes = model.actions(here, effect_code=effect_code.expand(-1, motions, -1), motion_code=motion_code)
        shape = (count, 1, OUTCOMES, pushes.shape[-2], here.objects, 2)
        uniform = torch.rand(shape, device=pushes.device, dtype=pushes.dtype).expand(-1, motions, -1, -1, -1, -1)
        ends, _ = sample_states(model, here, pushes.repeat_interleave(OUTCOMES, 1), uniform.flatten(1, 2))
        far = torch.where(here.mask, (ends.centers - wanted).norm(dim=-1), 0.0).sum(-1)  # [b, K 4]
        best = far.unflatten(1, (motions, OUTCOMES)).mean(-1).argmin(-1)
        chosen = pushes.take_along_dim(best[:, None, None, None], 1).expand(-1, OUTCOMES, -1, -1)
        attained, _ = sample_states(model, here, chosen, torch.rand_like(uniform[:, 0]))
    loss = distance_in_units(subgoal, attained).where(here.mask, 0.0).sum() / OUTCOMES
    return loss * (len(window.sequence_mask) / count)
