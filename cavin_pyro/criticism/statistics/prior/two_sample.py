"""Tests whether two paired samples come from the same distribution."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from scipy.stats import ks_2samp
from torch import Tensor


class TwoSample(NamedTuple):
    """Outcome of a test."""

    distance: float  # energy distance over its largest value: 0 for equal distributions, 1 for separate points
    chance: float  # its mean over permutations: the distance of equal distributions with as few samples
    p_value: float


def energy_test(
    first: Tensor, second: Tensor, *, episodes: Tensor | None = None, permutations: int = 999, seed: int = 0
) -> TwoSample:
    """Energy test (Székely and Rizzo, 2013) of samples `[N, D]` and `[N, D]`, row with row.

    2 E|x - y| - E|x - x'| - E|y - y'|, divided by 2 E|x - y|. Permutations exchange x and y within rows: what rows
    have in common (the state that both codes belong to) stays as it is, so the test holds for priors that depend on the
    state as well. But it compares the marginal samples only: a prior whose codes belong to other states passes.
    The p-value is at least 1 / (permutations + 1).

    Args:
        episodes: `[N]`; rows of one episode are exchanged together.

    Raises:
        ValueError: samples of different shape.
    """
    if first.shape != second.shape or first.dim() != 2:
        raise ValueError(f"samples [N, D] of one shape are wanted, not {[*first.shape]} and {[*second.shape]}")
    count, both = len(first), torch.cat((first, second)).double()
    distances = torch.cdist(both, both)
    _, which = torch.unique(torch.arange(count) if episodes is None else episodes, return_inverse=True)
    groups = int(which.max()) + 1
    side = torch.randint(0, 2, (groups, permutations), generator=torch.Generator().manual_seed(seed)) * 2.0 - 1
    side = side[which]
    side = torch.cat((torch.ones(count, 1), side), 1).double() / count  # the samples as they came stand first
    signs = torch.cat((side, -side))
    # With weights 1 / N on one sample and -1 / N on the other, the energy is minus a quadratic form.
    energies = -(signs * (distances @ signs)).sum(0)
    across = 2 * distances[:count, count:].mean()
    p_value = (energies >= energies[0] * (1 - 1e-9)).double().mean().item()  # counts the first itself
    scaled = energies / across.clamp(min=1e-12)
    return TwoSample(scaled[0].item(), scaled[1:].mean().item(), p_value)


class CodeComparison(NamedTuple):
    """Codes `[N, D]` from guide and prior, and tests of their difference."""

    guide: Tensor
    prior: Tensor
    whole: TwoSample
    active: TwoSample | None  # over the active dimensions only; the others, equal to the prior, would dilute it
    statistics: Tensor  # Kolmogorov-Smirnov, [D]
    p_values: Tensor  # times D (Bonferroni), at most 1, [D]

    @property
    def worst(self) -> list[int]:
        """Dimensions, those that differ most first."""
        return self.statistics.argsort(descending=True).tolist()


def compare_codes(
    guide: Tensor,
    prior: Tensor,
    *,
    active: Tensor,
    episodes: Tensor | None = None,
    permutations: int = 999,
    seed: int = 0,
) -> CodeComparison:
    """Tests of codes `[N, D]` against codes `[N, D]`, paired by row; `active: [D]` bool; `episodes: [N]`."""
    together: dict[str, Any] = {"episodes": episodes, "permutations": permutations, "seed": seed}
    tests = [ks_2samp(x.numpy(), y.numpy()) for x, y in zip(guide.double().T, prior.double().T, strict=True)]
    p_values = torch.tensor([float(test.pvalue) for test in tests], dtype=torch.float64)
    statistics = torch.tensor([float(test.statistic) for test in tests], dtype=torch.float64)
    whole = energy_test(guide, prior, **together)
    part = energy_test(guide[:, active], prior[:, active], **together) if active.any() else None
    return CodeComparison(guide, prior, whole, part, statistics, (p_values * len(tests)).clamp(max=1.0))


def projection(comparison: CodeComparison) -> Tensor:
    """The two directions `[D, 2]`, at right angles, along which the second moments of both differ most."""
    second = [codes.double().T @ codes.double() / len(codes) for codes in (comparison.guide, comparison.prior)]
    sizes, directions = torch.linalg.eigh(second[0] - second[1])
    return directions[:, sizes.abs().argsort(descending=True)[:2]]
