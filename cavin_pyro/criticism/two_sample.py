"""Whether two samples, drawn in pairs, come from the same distribution."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class TwoSample(NamedTuple):
    """Outcome of a test."""

    distance: float  # energy distance over its largest value: 0 for equal distributions, 1 for separate points
    chance: float  # its mean over permutations: what equal distributions come to with so few draws
    p_value: float


def energy_test(first: Tensor, second: Tensor, *, permutations: int = 999, seed: int = 0) -> TwoSample:
    """Energy test (Székely and Rizzo, 2013) of samples `[N, D]` and `[N, D]`, row with row.

    2 E|x - y| - E|x - x'| - E|y - y'|, divided by 2 E|x - y|. Permutations exchange x and y within rows: what rows
    have in common (the state that both codes belong to) stays as it is, so the test holds for priors that hang on the
    state as well. The p-value is at least 1 / (permutations + 1).

    Raises:
        ValueError: samples of different shape.
    """
    if first.shape != second.shape or first.dim() != 2:
        raise ValueError(f"samples [N, D] of one shape are wanted, not {[*first.shape]} and {[*second.shape]}")
    count, both = len(first), torch.cat((first, second)).double()
    distances = torch.cdist(both, both)
    side = torch.randint(0, 2, (count, permutations), generator=torch.Generator().manual_seed(seed)) * 2.0 - 1
    side = torch.cat((torch.ones(count, 1), side), 1).double() / count  # the samples as they came stand first
    signs = torch.cat((side, -side))
    # With weights 1 / N on one sample and -1 / N on the other, the energy is minus a quadratic form.
    energies = -(signs * (distances @ signs)).sum(0)
    across = 2 * distances[:count, count:].mean()
    p_value = (energies >= energies[0] * (1 - 1e-9)).double().mean().item()  # counts the first itself
    scaled = energies / across.clamp(min=1e-12)
    return TwoSample(scaled[0].item(), scaled[1:].mean().item(), p_value)
