"""Conditional normalising flows over codes: RealNVP couplings from zuko, as distributions of Pyro."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor, nn
from torch.distributions import Distribution

# zuko switches argument checks off for every distribution of the process when it is imported.
_checks_arguments = Distribution._validate_args
import zuko  # noqa: E402

Distribution.set_default_validate_args(_checks_arguments)


class FlowDistribution(TorchDistribution):
    """A base pushed through an invertible transform: batch `[...]`, event `[D]`.

    What was drawn last is scored at no cost. No KL divergence has a closed form here, so `TraceMeanField_ELBO` takes
    the one-sample estimate that `Trace_ELBO` takes. (`pyro.contrib.zuko.ZukoToPyro` has neither `sample`, which
    planning calls, nor a bound to its cache.)
    """

    arg_constraints: dict[str, Any] = {}
    support = constraints.real_vector
    has_rsample = True

    def __init__(self, flow: zuko.distributions.NormalizingFlow, validate_args: bool | None = None) -> None:
        self.flow = flow
        self._drawn: tuple[Tensor, Tensor] | None = None
        super().__init__(flow.batch_shape, flow.event_shape, validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> FlowDistribution:
        return FlowDistribution(self.flow.expand(torch.Size(batch_shape)), validate_args=self._validate_args)

    def sample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        return self.flow.sample(torch.Size(sample_shape))  # without the density that `rsample` computes

    def from_noise(self, noise: Tensor) -> Tensor:
        """What standard normal `noise: [..., D]` becomes, where the base is N(0, I): `[..., D]`, for planners."""
        return self.flow.transform.inv(noise)

    def rsample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        self._drawn = self.flow.rsample_and_log_prob(torch.Size(sample_shape))
        return self._drawn[0]

    def log_prob(self, value: Tensor) -> Tensor:
        if self._drawn is not None and value is self._drawn[0]:
            density = self._drawn[1]
            if density.requires_grad or not torch.is_grad_enabled():  # else drawn without gradients, scored with them
                return density
        if self._validate_args:
            self._validate_sample(value)
        return self.flow.log_prob(value.expand(torch.broadcast_shapes(value.shape, self.shape())))


class CodeFlow(nn.Module):
    """Turns a base distribution over a code into a richer one, given a context; the identity to begin with.

    Each coupling moves one half of the numbers of a code, x_b' = exp(s) x_b + t with (s, t) from the other half and the
    context by a network with one hidden layer; halves alternate. Couplings, because they are as fast backwards as
    forwards: guides draw, training scores, planning draws. An autoregressive flow needs D passes one of the two ways.

    `from_base` says which way the couplings run. From base to code (guides) a code is drawn and scored in one pass, and
    a foreign code is scored in two; from code to base (priors) a foreign code is scored in one pass.
    """

    def __init__(
        self, dimension: int, context_dimension: int, *, width: int = 32, transforms: int = 4, from_base: bool = False
    ) -> None:
        super().__init__()
        self.from_base = from_base
        couplings = [_identity_coupling(dimension, context_dimension, width, half % 2) for half in range(transforms)]
        self.couplings = zuko.lazy.LazyComposedTransform(*couplings)

    def forward(self, base: TorchDistribution, context: Tensor) -> FlowDistribution:
        """`base` of batch `[...]` and event `[dimension]`, `context: [..., context_dimension]` -> of the same shape."""
        couplings = self.couplings(context)
        to_base = couplings.inv if self.from_base else couplings
        return FlowDistribution(zuko.distributions.NormalizingFlow(to_base, base))


def _identity_coupling(dimension: int, context_dimension: int, width: int, half: int) -> nn.Module:
    coupling = zuko.flows.coupling.GeneralCouplingTransform(
        dimension, context_dimension, torch.arange(dimension) % 2 == half, hidden_features=(width,)
    )
    nn.init.zeros_(coupling.hyper[-1].weight)
    nn.init.zeros_(coupling.hyper[-1].bias)
    return coupling
