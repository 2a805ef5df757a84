"""Importance weights of a proposal: bounds on the evidence, and the Pareto shape of their tail."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from pyro.ops.stats import fit_generalized_pareto
from torch import Tensor

SMALLEST_TAIL = 10


class Weights(NamedTuple):
    """Statistics of a proposal's log weights `[N, B]`."""

    bounds: dict[int, Tensor]  # by K, [B]
    shapes: Tensor  # k-hat [B]
    episodes: Tensor  # [B]
    limit: float  # of k-hat, for so many samples

    @classmethod
    def of(cls, log_weights: Tensor, particles: Sequence[int], episodes: Tensor) -> Weights:
        """From log weights `[N, B]` of windows from `episodes: [B]`, for bounds of several K."""
        limit = reliable_limit(len(log_weights))
        return cls(evidence_bounds(log_weights, particles), pareto_shapes(log_weights), episodes, limit)

    @property
    def unreliable(self) -> Tensor:
        """Windows whose weights are not to be trusted: `[B]`, 0 or 1."""
        return (self.shapes > self.limit).double()

    @property
    def gap(self) -> Tensor:
        """The largest bound minus the ELBO: `[B]` nats."""
        return self.bounds[max(self.bounds)] - self.bounds[min(self.bounds)]


def reliable_limit(samples: int) -> float:
    """The k-hat above which so many importance weights are not to be trusted: min(1 - 1 / log10 S, 0.7).

    Vehtari, Simpson, Gelman, Yao and Gabry, "Pareto smoothed importance sampling", 2024, section 3.2.4: few samples
    need a lighter tail. Ten samples or fewer are never to be trusted unless the weights are bounded (limit 0).
    """
    return max(0.0, min(1 - 1 / math.log10(samples), 0.7)) if samples > 10 else 0.0


def evidence_bounds(log_weights: Tensor, particles: Sequence[int]) -> dict[int, Tensor]:
    """The K-particle bound on log p(observed) of each window (Burda et al., 2016), for several K.

    E log (1/K) sum_k w_k, one log for each window: K = 1 is the ELBO, and more particles come nearer to the evidence
    (`pyro.infer.RenyiELBO` takes one log for a whole batch, which is a looser bound). All N samples are used: they are
    cut into N // K groups, over which the bound is averaged.

    Args:
        log_weights: `[N, B]`. particles: values of K, at most N each.

    Returns:
        By K, `[B]`.

    Raises:
        ValueError: a K that is not within 1 to N.
    """
    bounds = {}
    for K in particles:
        groups = len(log_weights) // K if K > 0 else 0
        if not groups:
            raise ValueError(f"a bound of {K} particles cannot be made from {len(log_weights)} samples")
        grouped = log_weights[: groups * K].unflatten(0, (groups, K))
        bounds[K] = (grouped.logsumexp(1) - math.log(K)).mean(0)
    return bounds


def pareto_shapes(log_weights: Tensor, *, flat: float = 1e-3) -> Tensor:
    """k-hat of each column of `log_weights: [N, B]`: `[B]` float64.

    The generalised Pareto shape of the largest min(N / 5, 3 sqrt(N)) weights, as `pyro.infer.importance` fits it: below
    0.5 the weights have a variance; `reliable_limit` tells above which value so many of them are not enough.

    Args:
        flat: nats; weights that differ by less are equal but for rounding. Their k-hat is -inf. Where one weight
            outweighs so many others that no tail is left to fit, it is inf.
    """
    return torch.tensor([_pareto_shape(column, flat) for column in log_weights.double().T], dtype=torch.float64)


def _pareto_shape(log_weights: Tensor, flat: float) -> float:
    ordered = (log_weights - log_weights.max()).sort().values
    if ordered[0] > -flat:
        return -math.inf
    length = math.ceil(min(0.2 * len(ordered), 3.0 * math.sqrt(len(ordered))))
    cutoff = max(math.log(1e-15), ordered[-length - 1].item())
    tail = ordered[ordered > cutoff]
    if len(tail) < SMALLEST_TAIL:
        return math.inf
    shape, _ = fit_generalized_pareto(tail.exp() - math.exp(cutoff))
    return shape if math.isfinite(shape) else math.inf
