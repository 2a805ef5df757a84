"""The Renyi bound as a loss that torch can differentiate, for one optimizer over model and guide."""

from __future__ import annotations

import math

from pyro.infer import RenyiELBO
from torch import Tensor, nn

from cavin_pyro.training.elbo import window_terms
from models.state import Window


class DifferentiableRenyiELBO(RenyiELBO):
    """Pyro's Renyi bound of order alpha in the form that `ELBO()(model, guide)` needs, for programs over windows.

    L_alpha = sum over windows of 1 / (1 - alpha) log mean_k (p(x, c_k, z_k) / q(c_k, z_k | x))^(1 - alpha)

    alpha = 0 is the importance-weighted bound of K = `num_particles` particles (Burda et al. 2016; Li and
    Turner 2016). Pyro implements the value and a backward pass that finds parameters through its global
    store; this is the same value as a tensor. Codes must be reparameterized.
    """

    def differentiable_loss(
        self, model: nn.Module, guide: nn.Module, window: Window, *, encoded: Tensor | None = None
    ) -> Tensor:
        """The negative bound, a scalar summed over the windows `[B]`; `encoded` as in `window_terms`.

        Raises `ValueError` unless the particles are vectorized.
        """
        particles = self.num_particles
        if particles > 1 and not self.vectorize_particles:
            raise ValueError("the Renyi bound is computed for all particles at once: set vectorize_particles=true")
        terms = window_terms(model, guide, window, particles=particles, encoded=encoded)
        log_weight = -sum(terms.values())  # [K, B]
        order = 1.0 - self.alpha
        bound = ((order * log_weight).logsumexp(0) - math.log(particles)) / order
        return -bound.sum()
