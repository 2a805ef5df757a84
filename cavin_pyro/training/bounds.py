"""Bounds other than `Trace_ELBO`, as losses that torch can differentiate, for one optimizer over model and guide."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import pyro
import torch
from pyro.infer import TraceGraph_ELBO
from torch import Tensor, nn

from cavin_pyro.models.state import Window


@runtime_checkable
class DifferentiableBound(Protocol):
    """A bound whose loss is a tensor with gradients, as most of Pyro's are; their base class does not declare it."""

    def differentiable_loss(self, model: Any, guide: Any, *args: Any, **kwargs: Any) -> Any:
        """The loss, a scalar, summed over the windows that the programs are called with."""


def loss_with_gradients(
    elbo: Any, model: Any, guide: Any, window: Window, parameters: Sequence[nn.Parameter]
) -> Tensor:
    """A scalar with the value of `elbo.loss_and_grads` and its gradients, summed over the windows `[B]`.

    `TraceGraph_ELBO`, `RenyiELBO` and `ReweightedWakeSleep` have no `differentiable_loss`. The last two look for
    parameters in Pyro's store, so this opens an empty one for the call. Of several losses the first is the value.
    """
    before = [parameter.grad for parameter in parameters]
    local = isinstance(elbo, TraceGraph_ELBO)
    with pyro.settings.context(module_local_params=local), pyro.get_param_store().scope():
        if not torch.is_grad_enabled():
            losses = elbo.loss(model, guide, window)
            return torch.as_tensor(losses[0] if isinstance(losses, tuple) else losses)
        for parameter in parameters:
            parameter.grad = None
        losses = elbo.loss_and_grads(model, guide, window)
    gradients = [parameter.grad for parameter in parameters]
    for parameter, kept in zip(parameters, before, strict=True):
        parameter.grad = kept
    # Zero, with these gradients.
    carrier = sum(
        ((parameter - parameter.detach()) * gradient).sum()
        for parameter, gradient in zip(parameters, gradients, strict=True)
        if gradient is not None
    )
    return carrier + (losses[0] if isinstance(losses, tuple) else losses)
