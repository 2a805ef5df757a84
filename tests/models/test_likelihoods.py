from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from pyro import distributions

from models.isotropic import IsotropicNormal
from models.likelihoods import LikelihoodScales, PredictedScales
from models.state import State


def test_default_scales_are_those_of_the_published_loss_weights() -> None:
    # weight / KL weight = 1 / variance; the action's weight is a mean over T = 3 pushes of two coordinates.
    scales = LikelihoodScales()
    assert scales.center == pytest.approx((0.1 / 1000) ** 0.5, rel=0.01)
    assert scales.feature == pytest.approx((0.1 / 10) ** 0.5, rel=0.01)
    assert scales.motion == pytest.approx((3 * 0.1 / 5) ** 0.5, rel=0.01)
    assert scales.start == pytest.approx((3 * 0.1 / 50) ** 0.5, rel=0.01)


def test_isotropic_normal_equals_a_normal_of_independent_components() -> None:
    loc, value = torch.randn(2, 5, 3, dtype=torch.float64), torch.randn(2, 5, 3, dtype=torch.float64)
    ours = IsotropicNormal(loc, 0.3)
    theirs = distributions.Normal(loc, 0.3).to_event(1)
    assert (ours.batch_shape, ours.event_shape) == (theirs.batch_shape, theirs.event_shape)
    assert torch.allclose(ours.log_prob(value), theirs.log_prob(value), rtol=1e-12)
    assert torch.allclose(ours.variance, theirs.variance)
    expanded = ours.expand((4, 2, 5))
    assert torch.allclose(expanded.log_prob(value), theirs.log_prob(value).expand(4, 2, 5), rtol=1e-12)
    torch.manual_seed(1)
    sampled = ours.rsample((7,))
    torch.manual_seed(1)
    assert torch.allclose(sampled, theirs.rsample((7,)), rtol=1e-12)
    assert IsotropicNormal(torch.zeros(3), 0.3).sample((20_000,)).std().item() == pytest.approx(0.3, rel=0.02)


def test_isotropic_normal_refuses_invalid_scales_and_values() -> None:
    with pytest.raises(ValueError, match="scale must be positive, not 0"):
        IsotropicNormal(torch.zeros(3), 0.0)
    with pytest.raises(ValueError):
        IsotropicNormal(torch.tensor([float("nan")]), 1.0, validate_args=True)
    with pytest.raises(ValueError):
        IsotropicNormal(torch.zeros(1), 1.0, validate_args=True).log_prob(torch.tensor([float("nan")]))


def test_objects_that_do_not_count_add_nothing(random_state: Callable[..., State]) -> None:
    mean, observed = random_state(2, 3, real=2), random_state(2, 3)
    scales = LikelihoodScales()
    likelihood = scales.centers(mean, mean.mask, event_dims=2)
    assert (likelihood.batch_shape, likelihood.event_shape) == ((2,), (3, 4, 3))
    by_hand = distributions.Normal(mean.centers[:, :, :2], 0.01).log_prob(observed.centers[:, :, :2])
    assert torch.allclose(likelihood.log_prob(observed.centers), by_hand.sum((1, 2, 3)), rtol=1e-5)
    features = scales.features(mean, mean.mask)
    assert (features.batch_shape, features.event_shape) == ((2, 3), (4, 6))


def test_starts_are_weighted_more_than_motions() -> None:
    likelihood = LikelihoodScales().actions(torch.zeros(2, 3, 4))
    assert (likelihood.batch_shape, likelihood.event_shape) == ((2,), (3, 4))
    start, motion = torch.zeros(3, 4), torch.zeros(3, 4)
    start[0, 1], motion[0, 2] = 0.077, 0.245
    peak = likelihood.log_prob(torch.zeros(3, 4))
    assert torch.allclose(peak - likelihood.log_prob(start), torch.full((2,), 0.5), atol=1e-5)
    assert torch.allclose(peak - likelihood.log_prob(motion), torch.full((2,), 0.5), atol=1e-5)


@pytest.mark.parametrize("scales", [LikelihoodScales(), PredictedScales()], ids=["fixed", "predicted"])
def test_errors_in_the_plane_are_distributed_as_the_likelihood_of_centres(scales: LikelihoodScales) -> None:
    torch.manual_seed(0)
    count, own = 200_000, torch.full((200_000, 1), 0.02)
    mean = State(torch.zeros(count, 1, 3), torch.zeros(count, 1, 4), torch.ones(count, 1, dtype=torch.bool))
    likelihood = scales.centers(mean, mean.mask, predicted=own.unsqueeze(-1).expand(-1, -1, 2))
    parts = torch.tensor([0.1, 0.5, 0.9, 0.99])
    drawn = likelihood.sample()[:, 0, :2].norm(dim=-1).quantile(parts)
    errors = scales.planar_errors(torch.rand(count, 1, 2), own)
    assert torch.allclose(errors.norm(dim=-1)[:, 0].quantile(parts), drawn, rtol=0.04)
    assert errors.mean((0, 1)).abs().max() < 5e-4
    other = LikelihoodScales(center=0.02) if isinstance(scales, PredictedScales) else PredictedScales()
    wrong = other.planar_errors(torch.rand(count, 1, 2), own).norm(dim=-1)[:, 0].quantile(parts)
    assert not torch.allclose(wrong, drawn, rtol=0.2)
