"""A mixture over the objects as the prior of a code, instead of the paper's N(0, I)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from pyro.distributions import TorchDistribution, constraints
from torch import Tensor, nn
from torch.nn import functional

from cavin_pyro.models.networks.layers import SCALE_FLOOR
from cavin_pyro.models.priors.prior import LearnedPrior
from cavin_pyro.models.state import State

SYMMETRY_BREAKING = 1e-3  # standard deviation of the head's first weights: equal components would stay equal
LEAST_QUANTILE = 1e-6  # of a component's noise, so that it stays finite


class ObjectMixturePrior(LearnedPrior):
    """Mixture of diagonal Gaussians p(c | s) or p(z | s, c), some components for each object.

    i ~ Categorical(weights(s, c))          # object and component, real objects only
    code ~ N(mean_i(s, c), scale_i(s, c))

    A segment moves one object or another: its codes lie in as many places as there are objects, and one Gaussian over
    all of them covers what lies between, where actions touch nothing. The index i is summed out, so that there is no
    discrete site. It is initialised close to N(0, I), the paper's prior. Its divergences have no closed form:
    `TraceMeanField_ELBO` uses the one-sample estimate of `Trace_ELBO`.
    """

    def __init__(self, *, width: int = 32, components: int = 4, **shared: Any) -> None:
        """`components`: number of Gaussians per object. `shared`: the arguments of `LearnedPrior`."""
        super().__init__(width=width, **shared)
        dimension, self.components = self.dimension, components
        self.own = nn.Linear(width, width)
        self.head = nn.Linear(width, components * (1 + 2 * dimension))
        nn.init.normal_(self.head.weight, std=SYMMETRY_BREAKING)
        start = torch.zeros(components, 1 + 2 * dimension)
        start[:, 1 + dimension :] = math.log(math.expm1(1 - SCALE_FLOOR))
        self.head.bias = nn.Parameter(start.flatten())

    def forward(self, state: State, effect_code: Tensor | None = None) -> TorchDistribution:
        """`state: [...]`, `effect_code: [..., C]` for motions -> batch `[...]`, event `[dimension]`."""
        objects, scene = self.context.parts(state, effect_code)
        hidden = (self.own(objects) + scene.unsqueeze(-2)).relu()
        values = self.head(hidden).unflatten(-1, (self.components, -1)).flatten(-3, -2)
        score, mean, scale = values.split((1, self.dimension, self.dimension), -1)
        real = state.mask.repeat_interleave(self.components, -1).expand(score.shape[:-1])
        # The smallest finite number, not -inf: a scene without objects must not give NaN.
        score = score.squeeze(-1).masked_fill(~real, torch.finfo(score.dtype).min)
        return GaussianMixture(score, mean, scale)


def _positive(values: Tensor) -> Tensor:
    # Softplus is ten times slower on tensors that are not contiguous.
    return functional.softplus(values.contiguous()) + SCALE_FLOOR


class GaussianMixture(TorchDistribution):
    """Mixture of K diagonal Gaussians over a code: batch `[...]`, event `[D]`.

    Unlike torch's `MixtureSameFamily` its samples are a function of standard normal noise, which planners keep from one
    plan to the next (`reparameterize`). That function jumps from one component to the next, so it is no `rsample`:
    gradients through it would miss the weights.
    """

    arg_constraints: dict[str, Any] = {}
    support = constraints.real_vector
    has_rsample = False

    def __init__(self, score: Tensor, mean: Tensor, scale: Tensor, validate_args: bool | None = None) -> None:
        """`score: [..., K]` logarithms of weights up to a constant; `mean, scale: [..., K, D]`.

        Softplus makes a scale of each number of `scale`: a sample needs the chosen component's alone.
        """
        self.log_weights = score.log_softmax(-1)
        self.mean_of_each, self._scale = mean, scale
        super().__init__(score.shape[:-1], mean.shape[-1:], validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> GaussianMixture:
        shape = torch.Size(batch_shape)
        return GaussianMixture(
            self.log_weights.expand(shape + self.log_weights.shape[-1:]),
            self.mean_of_each.expand(shape + self.mean_of_each.shape[-2:]),
            self._scale.expand(shape + self._scale.shape[-2:]),
            validate_args=self._validate_args,
        )

    @property
    def scale_of_each(self) -> Tensor:
        """`[..., K, D]`."""
        return _positive(self._scale)

    @property
    def mean(self) -> Tensor:
        """`[..., D]`."""
        return (self.log_weights.exp().unsqueeze(-1) * self.mean_of_each).sum(-2)

    @property
    def variance(self) -> Tensor:
        """`[..., D]`."""
        spread = self.scale_of_each**2 + (self.mean_of_each - self.mean.unsqueeze(-2)) ** 2
        return (self.log_weights.exp().unsqueeze(-1) * spread).sum(-2)

    def log_prob(self, value: Tensor) -> Tensor:
        if self._validate_args:
            self._validate_sample(value)
        scale = self.scale_of_each
        error = (value.unsqueeze(-2) - self.mean_of_each) / scale
        normal = -0.5 * error**2 - scale.log() - 0.5 * math.log(2 * math.pi)
        return (self.log_weights + normal.sum(-1)).logsumexp(-1)

    def sample(self, sample_shape: Sequence[int] = torch.Size()) -> Tensor:
        shape = self.shape(torch.Size(sample_shape))
        with torch.no_grad():
            noise = torch.randn(shape, dtype=self.mean_of_each.dtype, device=self.mean_of_each.device)
            return self.reparameterize(noise)

    def reparameterize(self, noise: Tensor) -> Tensor:
        """The sample `[..., D]` that standard normal `noise: [..., D]` determines, for planners.

        The quantile of its first number chooses the component. Within the component's share of quantiles that number is
        uniform again, and becomes the noise of the first coordinate.
        """
        first = noise[..., :1]
        quantile = torch.special.ndtr(first)
        ends = self.log_weights.exp().cumsum(-1)
        component = (quantile > ends[..., :-1]).sum(-1, keepdim=True)
        end = ends.expand(*component.shape[:-1], -1).gather(-1, component)
        share = self.log_weights.exp().expand(*component.shape[:-1], -1).gather(-1, component)
        within = ((quantile - (end - share)) / share).clamp(LEAST_QUANTILE, 1 - LEAST_QUANTILE)
        normal = torch.cat((math.sqrt(2) * (2 * within - 1).erfinv(), noise[..., 1:]), -1)
        return self._of(self.mean_of_each, component) + _positive(self._of(self._scale, component)) * normal

    def _of(self, values: Tensor, component: Tensor) -> Tensor:
        """The chosen component's row of `values: [..., K, D]`, for `component: [..., 1]` -> `[..., D]`."""
        index = component.unsqueeze(-1).expand(*component.shape, values.shape[-1])
        return values.expand(*component.shape[:-1], *values.shape[-2:]).gather(-2, index).squeeze(-2)
