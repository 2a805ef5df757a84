"""The loss of a batch and its gradients as a CUDA graph, so that a GPU does not wait for Python.

A step of these small networks is some thousand short operations. Launched one at a time they take several times as
long as the GPU needs for them.
"""

from __future__ import annotations

from typing import Any

import torch
from pyro import poutine
from pyro.infer import Trace_ELBO
from torch import Tensor

from cavin_pyro.models.networks.layers import fixed_shapes
from cavin_pyro.models.state import Window
from cavin_pyro.planning.backends import Graph
from cavin_pyro.training.elbo import elbo_terms, latent_sites
from cavin_pyro.training.objectives import Loss, Objective
from cavin_pyro.training.resume import forked


def capturable(loss: Loss, window: Window) -> bool:
    """Whether a graph has the value and the gradients of this loss.

    The bound must be `Trace_ELBO` with one particle, whose loss for codes that are reparameterised is the sum of
    `elbo_terms` (Pyro's own method waits for the GPU at every site), without weights of KL terms. A subclass of the
    objective may do anything else.
    """
    objective = loss.objective
    if type(objective) is not Objective or type(loss) is not Loss or not loss.guide.amortized:
        return False
    if type(objective.elbo) is not Trace_ELBO or objective.elbo.num_particles != 1:
        return False
    if objective.weighted:
        return False
    with forked(window.actions.device), torch.no_grad():
        sites = latent_sites(poutine.trace(loss.guide).get_trace(window))
    return all(site["fn"].has_rsample for site in sites.values())


def capturable_loss(loss: Loss, window: Window) -> Tensor:
    """The loss of a batch `[B]` that is `capturable`, summed over its windows: a scalar."""
    with loss.model.encoding(window):
        terms = elbo_terms(loss.model, loss.guide, window)
    return sum((terms | loss.terms_of_model(window)).values(), window.actions.new_zeros(()))


class CapturedLoss:
    """Captures the mean loss per window, and its gradients, once for each shape of a batch, and replays it."""

    def __init__(self, loss: Loss) -> None:
        self._loss = loss
        self._parameters = [parameter for parameter in loss.parameters() if parameter.requires_grad]
        self._graphs: dict[torch.Size, Graph] = {}
        self._stream: Any = None  # one for all graphs, which else would share no memory

    def __call__(self, window: Window) -> Tensor:
        """The mean loss of a batch `[B]`, without gradients, which it writes to the parameters.

        Raises RuntimeError for a loss that waits for the GPU.
        """
        shape, device = window.states.centers.shape, window.actions.device
        if self._stream is None:
            self._stream, self._pool = torch.cuda.Stream(device), torch.cuda.graph_pool_handle()
        if shape not in self._graphs:
            with fixed_shapes():
                self._graphs[shape] = Graph(self._gradients, (window,), device, self._stream, self._pool)
        value, gradients = self._graphs[shape].replay((*window.states, *window[1:]))
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient
        return value

    def _gradients(self, window: Window) -> tuple[Tensor, list[Tensor | None]]:
        loss = capturable_loss(self._loss, window) / len(window.sequence_mask)
        gradients = torch.autograd.grad(loss, self._parameters, allow_unused=True)
        # Copies: a gradient may be a view of another one, and the caller clips them in place.
        return loss.detach(), [None if gradient is None else gradient.clone().contiguous() for gradient in gradients]
