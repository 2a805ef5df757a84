from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from pyro import distributions
from torch import Tensor

from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.models.likelihoods import IsotropicNormal, IsotropicStudentT, LikelihoodScales
from cavin_pyro.models.state import State


def numbers(*shape: int) -> Tensor:
    return torch.randn(shape, dtype=torch.float64)


def test_default_scales_are_those_of_the_published_loss_weights() -> None:
    # weight / KL weight = 1 / variance; the action's weight is a mean over T = 3 pushes of two coordinates.
    scales = LikelihoodScales(SPACE)
    expected = [(0.1 / 1000) ** 0.5, (0.1 / 10) ** 0.5, (3 * 0.1 / 50) ** 0.5, (3 * 0.1 / 5) ** 0.5]
    assert [scales.center, scales.feature, *scales.action] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("name", ["normal", "student", "upright"])
def test_densities_and_samples_are_those_of_pyros_distributions(name: str) -> None:
    loc, value, scale = numbers(4, 3), numbers(4, 3), 0.1 + numbers(4).abs()
    ours: Any = IsotropicNormal(loc, 0.3)
    theirs: Any = distributions.Normal(loc, 0.3).to_event(1)
    if name != "normal":
        heights = torch.tensor([1.0, 1.0, 0.4 if name == "upright" else 1.0], dtype=torch.float64)
        degrees = torch.tensor(5.0, dtype=torch.float64)
        theirs = distributions.MultivariateStudentT(degrees, loc, scale[:, None, None] * heights.diag())
        ours = IsotropicStudentT(5.0, loc, scale, 0.4 if name == "upright" else None)
    assert (ours.batch_shape, ours.event_shape) == (theirs.batch_shape, theirs.event_shape)
    assert torch.allclose(ours.log_prob(value), theirs.log_prob(value), atol=1e-10)
    assert torch.allclose(ours.expand((7, 4)).log_prob(value), theirs.log_prob(value).expand(7, 4), atol=1e-10)
    assert torch.allclose(ours.variance, theirs.variance)
    parts = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    away = [(one.sample((40_000,)) - loc).abs().quantile(parts, 0) for one in (ours, theirs)]
    assert torch.allclose(*away, rtol=0.06)


def test_heavy_tails_come_together_and_gradients_reach_the_scale() -> None:
    torch.manual_seed(0)
    loc, scale = torch.zeros(3, requires_grad=True), torch.tensor(2.0, requires_grad=True)
    samples = IsotropicStudentT(4.0, loc, scale).rsample((40_000,))
    far = (samples.abs() > 8.0).float()  # one chi-squared serves all components
    assert (far[:, 0] * far[:, 1]).mean() > 3 * far[:, 0].mean() * far[:, 1].mean()
    samples.square().sum().backward()
    assert loc.grad is not None and scale.grad is not None and scale.grad > 0


def test_what_is_not_positive_is_refused() -> None:
    with pytest.raises(ValueError, match="scale must be positive, not 0"):
        IsotropicNormal(torch.zeros(3), 0.0)
    with pytest.raises(ValueError, match="df must be more than 2, not 2"):
        IsotropicStudentT(2.0, torch.zeros(1, 3), torch.ones(1))
    with pytest.raises(ValueError, match="scales.action must be a number of at least 1e-12 and at most 1e.12, not -1"):
        LikelihoodScales(SPACE, action=(-1.0, 1.0))
    with pytest.raises(ValueError):
        IsotropicNormal(torch.zeros(1), 1.0, validate_args=True).log_prob(torch.tensor([float("nan")]))


def test_objects_that_do_not_count_add_nothing_and_starts_weigh_more_than_motions(
    random_state: Callable[..., State],
) -> None:
    mean, observed, scales = random_state(2, 3, real=2), random_state(2, 3), LikelihoodScales(SPACE)
    likelihood = scales.centers(mean, mean.mask, event_dims=2)
    assert (likelihood.batch_shape, likelihood.event_shape) == ((2,), (3, 4, 3))
    by_hand = distributions.Normal(mean.centers[:, :, :2], 0.01).log_prob(observed.centers[:, :, :2])
    assert torch.allclose(likelihood.log_prob(observed.centers), by_hand.sum((1, 2, 3)), rtol=1e-5)
    pushes, one, other = scales.actions(torch.zeros(2, 3, 4)), torch.zeros(3, 4), torch.zeros(3, 4)
    one[0, 1], other[0, 2] = 0.077, 0.245
    for push in (one, other):
        below = pushes.log_prob(torch.zeros(3, 4)) - pushes.log_prob(push)
        assert torch.allclose(below, torch.full((2,), 0.5), atol=1e-5)
