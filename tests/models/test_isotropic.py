from __future__ import annotations

import pytest
import torch
from pyro import distributions

from models.isotropic import IsotropicStudentT, UprightStudentT


def test_the_density_is_that_of_pyros_multivariate_t() -> None:
    loc, scale = torch.randn(4, 3, dtype=torch.float64), 0.1 + torch.rand(4, dtype=torch.float64)
    value = torch.randn(4, 3, dtype=torch.float64)
    matrices = scale[:, None, None] * torch.eye(3, dtype=torch.float64)
    expected = distributions.MultivariateStudentT(torch.tensor(3.0, dtype=torch.float64), loc, matrices)
    assert torch.allclose(IsotropicStudentT(3.0, loc, scale).log_prob(value), expected.log_prob(value), atol=1e-10)
    assert torch.allclose(IsotropicStudentT(3.0, loc, scale).variance, expected.variance)


def test_heights_have_a_scale_of_their_own() -> None:
    loc, scale = torch.randn(4, 3, dtype=torch.float64), 0.1 + torch.rand(4, dtype=torch.float64)
    value = torch.randn(4, 3, dtype=torch.float64)
    matrices = scale[:, None, None] * torch.tensor([1.0, 1.0, 0.4], dtype=torch.float64).diag()
    expected = distributions.MultivariateStudentT(torch.tensor(3.0, dtype=torch.float64), loc, matrices)
    upright = UprightStudentT(3.0, loc, scale, 0.4)
    assert torch.allclose(upright.log_prob(value), expected.log_prob(value), atol=1e-10)
    assert torch.allclose(upright.expand((5, 4)).log_prob(value), expected.log_prob(value).expand(5, 4), atol=1e-10)
    assert torch.allclose(upright.variance, expected.variance)
    torch.manual_seed(0)
    away = (UprightStudentT(5.0, loc, scale, 0.4).sample((20_000,)) - loc).abs().quantile(0.5, dim=0)
    assert torch.allclose(away[:, 2] / away[:, 0], torch.full((4,), 0.4, dtype=torch.float64), rtol=0.05)
    assert torch.allclose(away[:, 1] / away[:, 0], torch.ones(4, dtype=torch.float64), rtol=0.05)


def test_samples_have_the_densitys_quantiles() -> None:
    torch.manual_seed(0)
    samples = IsotropicStudentT(4.0, torch.zeros(3), torch.tensor(2.0)).sample((40_000,))
    each = torch.distributions.StudentT(4.0, 0.0, 2.0)
    for limit in (1.0, 4.0, 8.0):  # every component is a t with the same degrees of freedom
        expected = each.sample((200_000,)).abs().gt(limit).float().mean()
        assert samples[:, 0].abs().gt(limit).float().mean() == pytest.approx(expected.item(), abs=0.01)
    together = (samples.abs() > 8.0).float()  # heavy tails come together: one chi-squared serves all components
    assert (together[:, 0] * together[:, 1]).mean() > 3 * together[:, 0].mean() * together[:, 1].mean()


def test_gradients_reach_mean_and_scale() -> None:
    loc, scale = torch.zeros(2, 3, requires_grad=True), torch.ones(2, requires_grad=True)
    IsotropicStudentT(3.0, loc, scale).expand((5, 2)).rsample().square().sum().backward()
    assert loc.grad is not None
    assert scale.grad is not None
    assert (scale.grad > 0).all()


def test_too_few_degrees_of_freedom_are_refused() -> None:
    with pytest.raises(ValueError, match="df must be more than 2, not 2"):
        IsotropicStudentT(2.0, torch.zeros(1, 3), torch.ones(1))


@pytest.mark.parametrize("ratio", [0.0, -1.0, float("inf"), float("nan")])
def test_a_ratio_that_is_not_positive_is_refused(ratio: float) -> None:
    with pytest.raises(ValueError, match="ratio must be positive, not"):
        UprightStudentT(3.0, torch.zeros(1, 3), torch.ones(1), ratio)
