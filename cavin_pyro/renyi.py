"""The Renyi bound as a loss that torch can differentiate, for one optimiser over model and guide."""

from __future__ import annotations

import math
from typing import Any

from pyro.infer import RenyiELBO
from pyro.infer.util import get_dependent_plate_dims
from pyro.nn import PyroModule
from torch import Tensor


class DifferentiableRenyiELBO(RenyiELBO):
    """Pyro's Renyi bound of order alpha in the form that `ELBO()(model, guide)` needs.

    L_alpha = sum over windows of 1 / (1 - alpha) log mean_k (p(x, c_k, z_k) / q(c_k, z_k | x))^(1 - alpha)

    alpha = 0 is the importance-weighted bound of K = `num_particles` particles (Burda et al. 2016; Li and
    Turner 2016). Pyro implements the value and a backward pass that finds parameters through its global
    store; this is the same value as a tensor. Codes must be reparametrised.
    """

    def differentiable_loss(self, model: PyroModule, guide: PyroModule, *args: Any, **kwargs: Any) -> Tensor:
        """The negative bound, a scalar summed over the windows `[B]`.

        Raises `ValueError` unless the particles are vectorised.
        """
        if self.num_particles > 1 and not self.vectorize_particles:
            raise ValueError("the Renyi bound is computed for all particles at once: set vectorize_particles=true")
        ((joint, guided),) = self._get_traces(model, guide, args, kwargs)
        joint_dims = get_dependent_plate_dims(joint.nodes.values())
        log_weight: Tensor | float = 0.0
        for trace, sign in ((joint, 1.0), (guided, -1.0)):
            for site in trace.nodes.values():
                if site["type"] == "sample":
                    log_prob = site["log_prob"]
                    log_weight = log_weight + sign * (log_prob.sum(joint_dims) if joint_dims else log_prob)
        assert isinstance(log_weight, Tensor)
        if self.num_particles == 1:
            return -log_weight.sum()
        order = 1.0 - self.alpha
        bound = (order * log_weight).logsumexp(0) - math.log(self.num_particles)
        return -bound.sum() / order
