"""What only a mixture over the objects has; what all learned priors share is in `test_learned_priors.py`."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from models.priors.conditional import ConditionalPrior
from models.priors.mixture import GaussianMixture, ObjectMixturePrior
from models.state import State


def mixture(*batch: int, components: int = 3, dimension: int = 2) -> GaussianMixture:
    generator = torch.Generator().manual_seed(4)
    score, mean, scale = (
        torch.randn(*batch, components, size, generator=generator, dtype=torch.float64)
        for size in (1, dimension, dimension)
    )
    return GaussianMixture(score.squeeze(-1), 2 * mean, scale.exp())


def of_torch(own: GaussianMixture) -> MixtureSameFamily:
    return MixtureSameFamily(
        Categorical(logits=own.log_weights), Independent(Normal(own.mean_of_each, own.scale_of_each), 1)
    )


def test_density_mean_and_variance_are_those_of_torchs_mixture() -> None:
    own, codes = mixture(5), torch.randn(7, 5, 2).double()
    expected = of_torch(own)
    torch.testing.assert_close(own.log_prob(codes), expected.log_prob(codes), rtol=1e-12, atol=0)
    torch.testing.assert_close(own.mean, expected.mean)
    torch.testing.assert_close(own.variance, expected.variance)
    wide = own.expand((7, 5))
    assert wide.batch_shape == (7, 5)
    torch.testing.assert_close(wide.log_prob(codes), own.log_prob(codes))


def distance(samples: torch.Tensor, reference: torch.Tensor) -> float:
    """Largest difference of the empirical distribution functions of `[S]` and `[S]`."""
    places = torch.cat([samples, reference]).sort().values
    shares = [
        torch.searchsorted(values.sort().values, places, right=True) / len(values) for values in (samples, reference)
    ]
    return (shares[0] - shares[1]).abs().max().item()


def test_noise_becomes_codes_of_the_mixture_in_every_direction() -> None:
    own, generator = mixture(), torch.Generator().manual_seed(1)
    codes = own.reparameterize(torch.randn(20_000, 2, generator=generator, dtype=torch.float64))
    torch.manual_seed(2)
    expected = of_torch(own).sample((20_000,))
    narrow = GaussianMixture(own.log_weights, own.mean_of_each, 0.5 * own.scale_of_each)
    wrong = narrow.reparameterize(torch.randn(20_000, 2, generator=generator, dtype=torch.float64))
    for direction in ([1.0, 0.0], [0.0, 1.0], [0.7, 0.7], [-0.7, 0.7]):
        along = torch.tensor(direction, dtype=torch.float64)
        # The 0.1 % quantile of the Kolmogorov-Smirnov distance of two samples of 20,000 is 0.0195.
        assert distance(codes @ along, expected @ along) < 0.0195
        assert distance(wrong @ along, expected @ along) > 0.0195


@given(first=st.floats(-8.0, 8.0), precision=st.sampled_from([torch.float32, torch.float64]))
def test_extreme_noise_stays_finite(first: float, precision: torch.dtype) -> None:
    own = mixture(components=4)
    same = GaussianMixture(*(part.to(precision) for part in (own.log_weights, own.mean_of_each, own.scale_of_each)))
    assert same.reparameterize(torch.tensor([first, 0.0], dtype=precision)).isfinite().all()


def test_padding_is_never_chosen(random_state: Callable[..., State]) -> None:
    prior = ObjectMixturePrior(dimension=2, feature_dimension=6, components=2)
    for parameter in prior.parameters():
        nn.init.normal_(parameter, std=0.3)
    distribution = prior(random_state(50, objects=4, real=2))
    assert isinstance(distribution, GaussianMixture)
    weights = distribution.log_weights.exp()
    assert weights.shape == (50, 8)
    assert (weights[:, 4:] == 0).all()
    torch.testing.assert_close(weights.sum(-1), torch.ones(50))


def test_a_scene_without_objects_has_a_finite_prior(random_state: Callable[..., State]) -> None:
    distribution = ObjectMixturePrior(dimension=2, feature_dimension=6)(random_state(3, objects=4, real=0))
    assert distribution.log_prob(torch.zeros(3, 2)).isfinite().all()
    assert distribution.sample().isfinite().all()


def test_codes_that_lie_at_one_object_or_another_are_told_from_those_between(
    random_state: Callable[..., State],
) -> None:
    """One Gaussian covers what lies between two objects; the mixture does not."""

    def codes(state: State) -> torch.Tensor:
        chosen = torch.randint(2, (len(state.mask), 1, 1)).expand(-1, 1, 2)
        return 10 * state.centers[..., :2].gather(1, chosen).squeeze(1) + 0.05 * torch.randn(len(state.mask), 2)

    torch.manual_seed(0)
    held_out = random_state(512, objects=2, real=2)
    densities = {}
    for kind in (ConditionalPrior, ObjectMixturePrior):
        torch.manual_seed(1)
        prior = kind(dimension=2, feature_dimension=6, width=16)
        optimizer = torch.optim.Adam(prior.parameters(), 1e-2)
        for _ in range(300):
            state = random_state(128, objects=2, real=2)
            optimizer.zero_grad()
            (-prior(state).log_prob(codes(state))).mean().backward()
            optimizer.step()
        torch.manual_seed(2)
        densities[kind] = prior(held_out).log_prob(codes(held_out)).mean().item()
    assert densities[ObjectMixturePrior] > densities[ConditionalPrior] + 0.5


def test_at_least_one_component_is_needed() -> None:
    with pytest.raises(ValueError, match="components must be at least 1, not 0"):
        ObjectMixturePrior(components=0)
