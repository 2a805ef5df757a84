"""Weights of candidates from their returns, at a temperature that is given or adapted."""

from __future__ import annotations

import math

import torch
from torch import Tensor

TEMPERATURES = 97  # inverse temperatures on a grid, evenly spaced in the logarithm
RANGE = (1e-3, 1e9)  # of inverse temperatures times the range of returns, which one violation can widen a million times
SAME = 1.05  # effective sample sizes within this factor count as equal


def effective_sample_size(log_weights: Tensor) -> Tensor:
    """(sum w)^2 / sum w^2, the equivalent number of equally weighted candidates: `[..., n] -> [...]`; 0 without any."""
    weights = torch.softmax(log_weights, -1).nan_to_num(0.0)
    return (1.0 / weights.square().sum(-1)).nan_to_num(0.0, posinf=0.0)


def log_mean(log_weights: Tensor) -> Tensor:
    """The logarithm of the mean weight: `[..., n] -> [...]`; -inf if all are zero."""
    return log_weights.logsumexp(-1) - math.log(log_weights.shape[-1])


def adapt_temperature(returns: Tensor, fraction: float, before: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The lowest temperature at which the weights keep `fraction` of the effective sample size, and the log weights.

    If many share the highest return, much lower temperatures give the same weights; the highest of those is chosen.

    Weights are exp(return / temperature), divided by `exp(before)` (`[B, n]`, zero by default), for
    earlier resampling by these weights. returns: `[B, n]`, -inf for those that do not count; the fraction is of the
    others. Returns inverse temperatures `[B]` and log weights `[B, n]`, which are -inf where the returns are, in
    float64, because large returns at low temperatures exceed the precision of float32.
    """
    returns = returns.double()
    counts = torch.isfinite(returns)
    finite = torch.where(counts, returns, 0.0)
    highest = returns.masked_fill(~counts, -torch.inf).amax(-1, keepdim=True)
    lowest = returns.masked_fill(~counts, torch.inf).amin(-1, keepdim=True)
    spread = torch.where(highest > lowest, highest - lowest, 1.0)  # [B, 1]
    low, high = (math.log10(end) for end in RANGE)
    inverse = torch.logspace(low, high, TEMPERATURES, dtype=returns.dtype, device=returns.device) / spread  # [B, G]
    relative = torch.where(counts, finite - torch.where(torch.isfinite(highest), highest, 0.0), -torch.inf)
    history = torch.zeros_like(returns) if before is None else torch.where(counts, before, 0.0)
    logarithms = inverse.unsqueeze(-1) * relative.unsqueeze(-2) - history.unsqueeze(-2)  # [B, G, n]
    sizes = effective_sample_size(logarithms)
    enough = sizes >= fraction * counts.sum(-1, keepdim=True).clamp(min=1)
    ranks = torch.arange(TEMPERATURES, device=returns.device)
    # If no temperature keeps enough, take the one that keeps most.
    index = torch.where(enough.any(-1), torch.where(enough, ranks, -1).amax(-1), sizes.argmax(-1))
    weighs_the_same = enough & (sizes <= SAME * sizes.gather(-1, index.unsqueeze(-1)))
    index = torch.where(weighs_the_same.any(-1), weighs_the_same.int().argmax(-1), index)
    chosen = inverse.gather(-1, index.unsqueeze(-1)).squeeze(-1)
    environments = torch.arange(len(returns), device=returns.device)
    return chosen, logarithms[environments, index]
