"""Conditional normalising flows over codes: RealNVP couplings from zuko, as distributions of Pyro."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor, nn
from torch.distributions import Distribution

# Importing zuko disables argument checks of all distributions in the process.
_checks_arguments = Distribution._validate_args
import zuko  # noqa: E402

Distribution.set_default_validate_args(_checks_arguments)


class FlowDistribution(TorchDistribution):
    """A base distribution under an invertible transform: batch `[...]`, event `[D]`.

    The density of the last sample is cached, so scoring it is free. Its KL divergences have no closed form, so
    `TraceMeanField_ELBO` uses the one-sample estimate of `Trace_ELBO`. (`pyro.contrib.zuko.ZukoToPyro` has no
    `sample`, which planning calls, and its cache grows without bound.)
    """

    arg_constraints: dict[str, Any] = {}
    support = constraints.real_vector
    has_rsample = True

    def __init__(self, flow: zuko.distributions.NormalizingFlow, validate_args: bool | None = None) -> None:
        self.flow = flow
        self._scored_sample: tuple[Tensor, Tensor] | None = None
        super().__init__(flow.batch_shape, flow.event_shape, validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> FlowDistribution:
        return FlowDistribution(self.flow.expand(torch.Size(batch_shape)), validate_args=self._validate_args)

    def sample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        return self.flow.sample(torch.Size(sample_shape))  # skips the density that `rsample` computes

    def reparameterize(self, noise: Tensor) -> Tensor:
        """The sample `[..., D]` from standard normal `noise: [..., D]`, for planners; the base must be N(0, I)."""
        return self.flow.transform.inv(noise)

    def rsample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        self._scored_sample = self.flow.rsample_and_log_prob(torch.Size(sample_shape))
        return self._scored_sample[0]

    def log_prob(self, value: Tensor) -> Tensor:
        if self._scored_sample is not None and value is self._scored_sample[0]:
            density = self._scored_sample[1]
            # A sample without gradients may be scored with them.
            if density.requires_grad or not torch.is_grad_enabled():
                return density
        if self._validate_args:
            self._validate_sample(value)
        return self.flow.log_prob(value.expand(torch.broadcast_shapes(value.shape, self.shape())))


class CodeFlow(nn.Module):
    """Transforms a base distribution over a code, given a context; initialised to the identity.

    Each coupling transforms one half of a code, x_b' = exp(s) x_b + t, where a network with one hidden layer computes
    (s, t) from the other half and the context; halves alternate. Couplings are equally fast in both directions, and
    both are needed: guides sample, training scores, planning samples. An autoregressive flow takes D passes in one of
    them.

    `from_base` is the direction of the couplings. From base to code (guides), sampling with its density takes one pass
    and scoring another code takes two; from code to base (priors), scoring any code takes one pass.
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
