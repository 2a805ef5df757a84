from __future__ import annotations

import math
import subprocess
import sys

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro.distributions import Normal
from torch import Tensor
from torch.autograd.functional import jacobian

from cavin_pyro.models.networks.flows import CodeFlow

both_ways = pytest.mark.parametrize("from_base", [True, False])


def randomized(flow: CodeFlow, size: float = 0.5) -> CodeFlow:
    """In float64, with weights far from the identity."""
    for parameter in flow.double().parameters():
        torch.nn.init.normal_(parameter, std=size)
    return flow


def numbers(*shape: int) -> Tensor:
    return torch.randn(shape, dtype=torch.float64)


def standard(*shape: int) -> Normal:
    return Normal(torch.zeros(shape, dtype=torch.float64), 1.0).to_event(1)


@both_ways
@pytest.mark.parametrize("dimension", [1, 5])
def test_a_new_flow_is_the_identity(dimension: int, from_base: bool) -> None:
    flow = CodeFlow(dimension, 3, width=8, from_base=from_base).double()
    base, context = Normal(numbers(4, dimension), numbers(4, dimension).exp()).to_event(1), numbers(4, 3)
    changed = flow(base, context)
    torch.manual_seed(1)
    sampled = changed.rsample()
    torch.manual_seed(1)
    assert torch.equal(sampled, base.rsample())
    assert torch.equal(changed.log_prob(sampled), base.log_prob(sampled))
    assert torch.equal(changed.log_prob(sampled + 1), base.log_prob(sampled + 1))


@both_ways
@pytest.mark.parametrize("dimension", [1, 5])
def test_the_density_follows_from_the_jacobian(dimension: int, from_base: bool) -> None:
    """A code is a function of its noise z = mean + epsilon, and log q(code) = log N(z) - log |d code / d z|."""
    flow = randomized(CodeFlow(dimension, 3, width=8, from_base=from_base))
    mean, context = numbers(dimension), numbers(3)

    def code(mean: Tensor) -> Tensor:
        torch.manual_seed(1)
        return flow(Normal(mean, 1.0).to_event(1), context).rsample()

    torch.manual_seed(1)
    epsilon = numbers(dimension)
    log_normal = -0.5 * epsilon.square().sum() - 0.5 * dimension * math.log(2 * math.pi)
    expected = log_normal - jacobian(code, mean).det().abs().log()
    found = flow(Normal(mean, 1.0).to_event(1), context).log_prob(code(mean))
    assert (expected - log_normal).abs() > 0.05
    assert found.item() == pytest.approx(expected.item(), rel=1e-9)


@both_ways
def test_the_last_sample_is_scored_as_any_other_code(from_base: bool) -> None:
    flow = randomized(CodeFlow(5, 3, width=8, from_base=from_base))
    distribution = flow(standard(4, 5), numbers(4, 3))
    sampled = distribution.rsample()
    scores = [distribution.log_prob(sampled), distribution.log_prob(sampled.clone())]
    gradients = [torch.autograd.grad(score.sum(), list(flow.parameters()), retain_graph=True) for score in scores]
    assert torch.allclose(*scores, rtol=1e-10)
    assert all(torch.allclose(*pair, atol=1e-10) for pair in zip(*gradients, strict=True))


def test_codes_sampled_without_gradients_are_scored_with_them() -> None:
    """As wake-sleep does."""
    flow = randomized(CodeFlow(5, 3, width=8, from_base=True))
    distribution = flow(standard(4, 5), numbers(4, 3))
    with torch.no_grad():
        sampled = distribution.rsample()
    assert distribution.log_prob(sampled).requires_grad


@given(
    batch=st.lists(st.integers(1, 3), max_size=2),
    samples=st.lists(st.integers(1, 3), max_size=2),
    from_base=st.booleans(),
)
def test_each_element_of_a_batch_has_its_own_context(batch: list[int], samples: list[int], from_base: bool) -> None:
    flow = randomized(CodeFlow(3, 2, width=8, from_base=from_base))
    context = numbers(*batch, 2)
    distribution = flow(standard(*batch, 3), context)
    sampled = distribution.rsample(samples)
    assert (distribution.batch_shape, distribution.event_shape) == ((*batch,), (3,))
    assert sampled.shape == (*samples, *batch, 3)
    scores = distribution.log_prob(sampled)
    assert scores.shape == (*samples, *batch)
    one = flow(standard(3), context[(0,) * len(batch)])
    first = (0,) * (len(samples) + len(batch))
    assert torch.allclose(one.log_prob(sampled[first]), scores[first])
    wider = distribution.expand((2, *batch))
    assert torch.allclose(wider.log_prob(sampled[(0,) * len(samples)])[1], scores[(0,) * len(samples)])


def test_arguments_of_distributions_are_checked_as_before() -> None:
    program = (
        "from torch.distributions import Distribution, Normal\n"
        "for checked in (True, False):\n"
        "    Distribution.set_default_validate_args(checked)\n"
        "    [sys.modules.pop(name) for name in list(sys.modules) if name.startswith(('zuko', 'cavin_pyro.models'))]\n"
        "    import cavin_pyro.models.networks.flows\n"
        "    assert Normal(0.0, 1.0)._validate_args is checked, checked\n"
    )
    subprocess.run([sys.executable, "-c", f"import pyro, sys\n{program}"], check=True)
