"""The loss of a batch and its gradients as a CUDA graph, so that a GPU does not wait for Python.

A step of these small networks is some thousand short operations. Launched one at a time they take several times as
long as the GPU needs for them.
"""

from __future__ import annotations

from typing import Any

import torch
from pyro import poutine
from pyro.infer import Trace_ELBO
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from cavin_pyro.training.elbo import elbo_terms
from cavin_pyro.training.objectives import BoundObjective, Objective
from cavin_pyro.training.randomness import forked
from models.networks.shapes import fixed_shapes
from models.state import Window
from planning.backends.capture import Graph
from planning.backends.signature import flatten


def capturable(loss: BoundObjective, window: Window) -> bool:
    """Whether a graph has the value and the gradients of this loss.

    The bound must be `Trace_ELBO` with one particle, whose loss for codes that are reparameterised is the sum of
    `elbo_terms` (Pyro's own method waits for the GPU at every site), without weights of KL terms and a counterfactual
    term. A subclass of the objective may do anything else.
    """
    objective = loss.objective
    if type(objective) is not Objective or type(loss) is not BoundObjective:
        return False
    if type(objective.elbo) is not Trace_ELBO or objective.elbo.num_particles != 1 or not loss.guide.amortized:
        return False
    weighted = objective.warm_up_steps or any(weight != 1.0 for weight in objective.weights(0).values())
    return not weighted and not objective.counterfactual_weight and _reparameterized(loss, window)


def loss_of(loss: BoundObjective, window: Window) -> Tensor:
    """The loss of a batch `[B]` that is `capturable`, summed over its windows: a scalar."""
    encoded = loss.model.encode(window)
    terms = elbo_terms(loss.model, loss.guide, window, encoded=encoded)
    return sum((terms | loss.terms_of_model(window)).values(), window.actions.new_zeros(()))


class CapturedLoss:
    """Captures the mean loss per window, and its gradients, once for each shape of a batch, and replays it."""

    def __init__(self, loss: BoundObjective) -> None:
        self._loss = loss
        self._parameters = [parameter for parameter in loss.parameters() if parameter.requires_grad]
        self._graphs: dict[Any, Graph[tuple[Tensor, list[Tensor | None]]]] = {}
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, window: Window) -> Tensor:
        """The mean loss of a batch `[B]`, without gradients, which it writes to the parameters.

        Raises RuntimeError for a loss that waits for the GPU.
        """
        tensors: list[Tensor] = []
        signature: list[Any] = [torch.get_float32_matmul_precision()]
        flatten(window, tensors, signature)
        version = tuple(signature)
        if version not in self._graphs:
            with fixed_shapes():
                self._graphs[version] = Graph(self._gradients, (window,), tensors, window.actions.device, self._pool)
        value, gradients = self._graphs[version](tensors)
        for parameter, gradient in zip(self._parameters, gradients, strict=True):
            parameter.grad = gradient
        return value

    def _gradients(self, window: Window) -> tuple[Tensor, list[Tensor | None]]:
        loss = loss_of(self._loss, window) / len(window.sequence_mask)
        gradients = torch.autograd.grad(loss, self._parameters, allow_unused=True)
        # Copies: a gradient may be a view of another one, and the caller clips them in place.
        return loss.detach(), [None if one is None else one.clone().contiguous() for one in gradients]


def _reparameterized(loss: BoundObjective, window: Window) -> bool:
    with forked(window.actions.device), torch.no_grad():
        sites = [*poutine.trace(loss.guide).get_trace(window).nodes.values()]
    samplers: list[Any] = [site["fn"] for site in sites if site["type"] == "sample" and not site_is_subsample(site)]
    return all(sampler.has_rsample for sampler in samplers)
