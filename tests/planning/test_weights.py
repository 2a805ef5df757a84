"""Effective sizes, adaptive temperatures and shares of the samples."""

from __future__ import annotations

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cavin_pyro.planning.optimizers.base import samples_of_iteration
from cavin_pyro.planning.optimizers.weights import RANGE, SAME, TEMPERATURES, adapt_temperature, effective_sample_size

INFINITE = float("inf")
STEP = (RANGE[1] / RANGE[0]) ** (1 / (TEMPERATURES - 1))  # between neighbours on the grid of inverse temperatures


def test_effective_size_counts_equal_weights_and_nothing_else() -> None:
    logarithms = torch.tensor([[0.0, 0.0, 0.0, 0.0], [3.0, 3.0, -INFINITE, -INFINITE], [-INFINITE] * 4])
    torch.testing.assert_close(effective_sample_size(logarithms), torch.tensor([4.0, 2.0, 0.0]))


@settings(deadline=None, max_examples=50)
@given(
    seed=st.integers(0, 10_000),
    fraction=st.sampled_from([0.1, 0.3, 0.5, 0.9]),
    scale=st.sampled_from([1e-4, 1.0, 1e4]),
    failed=st.integers(0, 100),
)
@example(seed=264, fraction=0.3, scale=1e-4, failed=0)  # a gap between the best returns
def test_the_temperature_keeps_the_fraction_of_the_living_and_hardly_more(
    seed: int, fraction: float, scale: float, failed: int
) -> None:
    returns = scale * torch.randn(1, 200, generator=torch.Generator().manual_seed(seed))
    returns[:, :failed] = -INFINITE
    inverse, logarithms = adapt_temperature(returns, fraction)
    least = fraction * (200 - failed) * (1 - 1e-9)
    lower = [logarithms * STEP**number for number in range(12)]  # at lower and lower temperatures of the grid
    sizes = effective_sample_size(torch.cat(lower))
    enough = sizes >= least
    assert enough[0] and not enough[-1]
    assert sizes[0] <= SAME * sizes[enough].min()
    assert (logarithms[:, :failed] == -INFINITE).all()
    expected = torch.softmax(inverse[:, None] * (returns - returns.max()), -1)
    torch.testing.assert_close(torch.softmax(logarithms, -1), expected)


def test_where_nothing_counts_there_are_no_weights() -> None:
    inverse, logarithms = adapt_temperature(torch.full((1, 5), -INFINITE), 0.3)
    assert inverse.isfinite().all()
    assert (logarithms == -INFINITE).all()


@settings(max_examples=50)
@given(samples=st.integers(1, 5000), iterations=st.integers(1, 20))
def test_iterations_share_the_samples_evenly_and_completely(samples: int, iterations: int) -> None:
    if samples < iterations:
        with pytest.raises(ValueError, match=f"^{iterations} iterations need at least as many samples"):
            samples_of_iteration(samples, iterations, 0)
        return
    shares = [samples_of_iteration(samples, iterations, number) for number in range(iterations)]
    assert sum(shares) == samples
    assert max(shares) - min(shares) <= 1
