"""Coverage of distances to reference points: a test of samples against truths, in any number of dimensions.

After TARP: Lemos, Coogan, Hezaveh and Perreault-Levasseur, "Sampling-based accuracy testing of posterior estimators for
general inference", 2023.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cavin_pyro.criticism.statistics.clusters import Interval, bootstrap_interval

LEVELS = torch.linspace(0.05, 0.95, 19, dtype=torch.float64)


def credibility(truth: Tensor, samples: Tensor, references: Tensor) -> Tensor:
    """Share of samples that are nearer to a reference than the truth is: `[N]`, uniform if both have one distribution.

    A reference must not depend on the truth given the state. It should depend on the state: else samples that ignore
    the state pass.

    Args:
        truth: `[N, D]`. samples: `[S, N, D]`. references: `[N, D]`.
    """
    far = (truth - references).norm(dim=-1)
    distances = (samples - references).norm(dim=-1)
    # The rank is randomised within its step, so that uniform means exactly uniform.
    below, equal = (distances < far).sum(0), (distances == far).sum(0)
    return (below + torch.rand(far.shape, dtype=torch.float64) * (equal + 1)) / (len(samples) + 1)


def expected_coverage(credibilities: Tensor) -> Tensor:
    """Share of the N truths within the region of each of `LEVELS`: `[19]`, equal to the levels if all is right."""
    return (credibilities.unsqueeze(-1) <= LEVELS).double().mean(0)


def coverage_gap(credibilities: Tensor, episodes: Tensor, *, seed: int = 0) -> Interval:
    """Largest deviation of the expected coverage from its level, for credibilities `[N]`, resampled by episode."""
    inside = (credibilities.unsqueeze(-1) <= LEVELS).double()

    def gap(weights: Tensor) -> Tensor:
        return (weights @ inside / weights.sum(-1, keepdim=True) - LEVELS).abs().amax(-1)

    return bootstrap_interval(gap, episodes, seed=seed)


def gap_by_chance(count: int, *, seed: int = 0) -> float:
    """The mean `coverage_gap` of so many independent truths if all is right."""
    uniform = np.random.default_rng(seed).random((200, count))
    inside = (uniform[..., None] <= LEVELS.numpy()).mean(1)
    return float(np.abs(inside - LEVELS.numpy()).max(-1).mean())
