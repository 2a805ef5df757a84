from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cavin_pyro.criticism.statistics.inference.importance import Weights, evidence_bounds, pareto_shapes, reliable_limit


def test_bounds_take_one_logarithm_for_each_window_and_group() -> None:
    logs = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 9.0]], dtype=torch.float64).log()
    bounds = evidence_bounds(logs, (1, 2, 3, 4))
    assert bounds[1].tolist() == pytest.approx([math.log(105) / 4, math.log(432) / 4])
    assert bounds[2].tolist() == pytest.approx([math.log(2 * 6) / 2, math.log(3 * 7.5) / 2])
    assert bounds[3].tolist() == pytest.approx([math.log(3), math.log(4)])  # the fourth draw is left over
    assert bounds[4].tolist() == pytest.approx([math.log(4), math.log(21 / 4)])


@given(st.integers(0, 10_000), st.floats(0.1, 50.0))
def test_more_particles_never_lower_the_bound(seed: int, spread: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    logs = spread * torch.randn(16, 3, generator=generator, dtype=torch.float64) - 1000
    bounds = evidence_bounds(logs, (1, 2, 4, 8, 16))
    for fewer, more in ((1, 2), (2, 4), (4, 8), (8, 16)):
        assert bool((bounds[more] >= bounds[fewer] - 1e-9).all())
    assert bool((bounds[16] <= logs.amax(0) + 1e-9).all())


@pytest.mark.parametrize("particles", [0, 5])
def test_a_bound_needs_enough_samples(particles: int) -> None:
    with pytest.raises(ValueError, match=f"bound of {particles} particles cannot be made from 4 samples"):
        evidence_bounds(torch.zeros(4, 2), [particles])


def gaussian_weights(scale: float, samples: int = 100_000) -> torch.Tensor:
    """log N(x; 0, 1) / N(x; 0, scale^2) for x from the latter: [samples, 1]."""
    x = scale * torch.randn(samples, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return -0.5 * x**2 + 0.5 * (x / scale) ** 2 + math.log(scale)


@pytest.mark.parametrize("scale", [0.4, 0.6, 0.8])
def test_a_narrow_gaussian_proposal_has_the_shape_that_theory_gives(scale: float) -> None:
    # w > t means x^2 > 2 log t / (1 / scale^2 - 1), of probability t^(-1 / (1 - scale^2)) but for logarithms.
    assert pareto_shapes(gaussian_weights(scale)).item() == pytest.approx(1 - scale**2, abs=0.1)


def test_a_wide_gaussian_proposal_has_bounded_weights() -> None:
    assert pareto_shapes(gaussian_weights(1.5)).item() < 0


def test_equal_weights_have_no_tail_and_a_single_one_is_all_tail() -> None:
    logs = torch.zeros(1000, 3, dtype=torch.float64)
    logs[:, 1] += 1e-5 * torch.rand(1000)
    logs[0, 2] = 100.0
    assert pareto_shapes(logs - 500).tolist() == [-math.inf, -math.inf, math.inf]


@pytest.mark.parametrize("samples, limit", [(10, 0.0), (100, 0.5), (1000, 2 / 3), (10_000, 0.7)])
def test_few_weights_need_a_lighter_tail(samples: int, limit: float) -> None:
    assert reliable_limit(samples) == pytest.approx(limit)


def test_weights_are_judged_by_the_limit_of_their_number() -> None:
    logs = gaussian_weights(0.6).reshape(-1, 100)[:200]  # 200 of each of 100 windows; k-hat is 0.64 in theory
    found = Weights.of(logs, (1, 200), torch.arange(100))
    assert found.limit == pytest.approx(reliable_limit(200)) and found.limit < 0.6
    assert found.unreliable.mean() == (found.shapes > found.limit).double().mean() > 0.4
