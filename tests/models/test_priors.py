from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro.distributions import Normal
from torch import Tensor, nn
from torch.distributions import Categorical, Independent, MixtureSameFamily

from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.models.priors.conditional import ConditionalPrior
from cavin_pyro.models.priors.flow import FlowPrior
from cavin_pyro.models.priors.mixture import GaussianMixture, ObjectMixturePrior
from cavin_pyro.models.priors.standard import StandardPrior
from cavin_pyro.models.state import State

SIZES = {"space": SPACE, "dimension": 4, "feature_dimension": 6, "width": 8}
PRIORS = (ConditionalPrior, FlowPrior, ObjectMixturePrior)
each_prior = pytest.mark.parametrize("kind", PRIORS)


def randomized(prior: nn.Module) -> nn.Module:
    """In float64, with weights far from where training begins."""
    for parameter in prior.double().parameters():
        nn.init.normal_(parameter, std=0.3)
    return prior


def double(state: State) -> State:
    return state.map(lambda field: field.double() if field.is_floating_point() else field)


@pytest.mark.parametrize("kind", [StandardPrior, *PRIORS])
@pytest.mark.parametrize("effect_dimension", [None, 5])
def test_training_begins_at_the_standard_normal(
    kind: type, effect_dimension: int | None, random_state: Callable[..., State]
) -> None:
    sizes = {name: SIZES[name] for name in ("dimension", "feature_dimension")} if kind is StandardPrior else SIZES
    prior, codes = kind(**sizes, effect_dimension=effect_dimension), 3 * torch.randn(7, 4)
    distribution = prior(random_state(7), None if effect_dimension is None else torch.randn(7, 5))
    assert (distribution.batch_shape, distribution.event_shape) == ((7,), (4,))
    # The components of a mixture are not quite equal at first, or they would stay equal.
    tolerance = 1e-2 if kind is ObjectMixturePrior else 1e-5
    assert torch.allclose(distribution.log_prob(codes), Normal(0.0, 1.0).log_prob(codes).sum(-1), rtol=tolerance)


@settings(max_examples=25, deadline=None)
@given(kind=st.sampled_from(PRIORS), order=st.permutations(range(4)), real=st.integers(1, 4), motion=st.booleans())
def test_order_and_padding_of_objects_change_nothing(
    random_state: Callable[..., State], kind: type, order: list[int], real: int, motion: bool
) -> None:
    prior = randomized(kind(**SIZES, effect_dimension=5 if motion else None))
    effect_code = torch.randn(3, 5).double() if motion else None
    state, codes = double(random_state(3, objects=4, real=real)), torch.randn(3, 4).double()
    padding = ~state.mask.unsqueeze(-1)
    others = [
        State(state.centers[:, order], state.features[:, order], state.mask[:, order]),
        State(state.centers[:, :real], state.features[:, :real], state.mask[:, :real]),
        State(state.centers.masked_fill(padding, 9.0), state.features.masked_fill(padding, -7.0), state.mask),
    ]
    expected = prior(state, effect_code).log_prob(codes)
    for other in others:
        assert torch.allclose(prior(other, effect_code).log_prob(codes), expected, rtol=1e-9)


@settings(max_examples=25, deadline=None)
@given(kind=st.sampled_from(PRIORS), batch=st.lists(st.integers(1, 3), max_size=2), particles=st.integers(1, 3))
def test_leading_dimensions_of_state_and_effect_code_broadcast(
    random_state: Callable[..., State], kind: type, batch: list[int], particles: int
) -> None:
    prior = randomized(kind(**SIZES, effect_dimension=5))
    state, effect_code = double(random_state(*batch)), torch.randn(particles, *batch, 5).double()
    distribution, codes = prior(state, effect_code), torch.randn(particles, *batch, 4).double()
    assert (distribution.batch_shape, distribution.event_shape) == ((particles, *batch), (4,))
    scores = distribution.log_prob(codes)
    assert torch.allclose(scores[-1], prior(state, effect_code[-1]).log_prob(codes[-1]))
    assert prior(state, effect_code[(0,) * (len(batch) + 1)]).batch_shape == (*batch,)


@each_prior
def test_the_state_and_the_effect_matter_and_are_given_where_wanted(
    kind: type, random_state: Callable[..., State]
) -> None:
    prior, state = randomized(kind(**SIZES, effect_dimension=5)), double(random_state(2))
    effect_code, codes = torch.randn(2, 5).double(), torch.randn(2, 4).double()
    expected = prior(state, effect_code).log_prob(codes)
    moved, turned = state._replace(centers=state.centers + 0.05), state._replace(features=-state.features)
    for other in (prior(moved, effect_code), prior(turned, effect_code), prior(state, effect_code + 1)):
        assert not torch.allclose(other.log_prob(codes), expected, atol=1e-3)
    with pytest.raises(ValueError, match="this prior takes no effect code"):
        kind(**SIZES)(random_state(2), torch.randn(2, 5))


def target(state: State, noise: Tensor) -> Tensor:
    """Codes that lie where the objects do, far from N(0, I)."""
    place = (state.centers.mean(-2) - torch.tensor([0.6, 0.0, 0.0])) * 10
    return torch.cat([place[..., :2], place[..., :2]], -1) + 0.3 * noise


@each_prior
def test_training_moves_the_prior_towards_the_codes_that_occur(kind: type, random_state: Callable[..., State]) -> None:
    """The mean of -log p(code | s) is KL(codes that occur || prior) up to their entropy, which does not change."""
    prior, held_out, noise = kind(**SIZES), random_state(256), torch.randn(256, 4)
    optimizer = torch.optim.Adam(prior.parameters(), 1e-2)

    def gap() -> float:
        entropy = Normal(0.0, 0.3).log_prob(0.3 * noise).sum(-1)
        return (entropy - prior(held_out).log_prob(target(held_out, noise))).mean().item()

    before = gap()
    for _ in range(80):
        state = random_state(64)
        optimizer.zero_grad()
        (-prior(state).log_prob(target(state, torch.randn(64, 4)))).mean().backward()
        optimizer.step()
    assert before > 5
    assert gap() < 0.5 * before


def mixture(*batch: int, components: int = 3) -> tuple[GaussianMixture, MixtureSameFamily]:
    """A mixture, and the same of torch."""
    generator = torch.Generator().manual_seed(4)
    score, mean, scale = (
        torch.randn(*batch, components, size, generator=generator, dtype=torch.float64) for size in (1, 2, 2)
    )
    own = GaussianMixture(score.squeeze(-1), 2 * mean, scale)
    each = Independent(Normal(own.mean_of_each, own.scale_of_each), 1)
    return own, MixtureSameFamily(Categorical(logits=own.log_weights), each)


def test_density_mean_and_variance_are_those_of_torchs_mixture() -> None:
    (own, expected), codes = mixture(5), torch.randn(7, 5, 2).double()
    torch.testing.assert_close(own.log_prob(codes), expected.log_prob(codes), rtol=1e-12, atol=0)
    torch.testing.assert_close((own.mean, own.variance), (expected.mean, expected.variance))
    torch.testing.assert_close(own.expand((7, 5)).log_prob(codes), own.log_prob(codes))


def distance(samples: Tensor, reference: Tensor) -> float:
    """Largest difference of the empirical distribution functions of `[S]` and `[S]`."""
    places = torch.cat([samples, reference]).sort().values
    shares = [torch.searchsorted(one.sort().values, places, right=True) / len(one) for one in (samples, reference)]
    return (shares[0] - shares[1]).abs().max().item()


def test_noise_becomes_codes_of_the_mixture_in_every_direction_and_stays_finite() -> None:
    (own, theirs), generator = mixture(), torch.Generator().manual_seed(1)
    noise = torch.randn(2, 20_000, 2, generator=generator, dtype=torch.float64)
    torch.manual_seed(2)
    expected = theirs.sample((20_000,))
    narrow = GaussianMixture(own.log_weights, own.mean_of_each, torch.full_like(own.mean_of_each, -3.0))
    for direction in ([1.0, 0.0], [0.0, 1.0], [0.7, 0.7], [-0.7, 0.7]):
        along = torch.tensor(direction, dtype=torch.float64)
        # The 0.1 % quantile of the Kolmogorov-Smirnov distance of two samples of 20,000 is 0.0195.
        assert distance(own.reparameterize(noise[0]) @ along, expected @ along) < 0.0195
        assert distance(narrow.reparameterize(noise[1]) @ along, expected @ along) > 0.0195
    for first in (-8.0, -5.0, 5.0, 8.0):
        assert own.reparameterize(torch.tensor([first, 0.0], dtype=torch.float64)).isfinite().all()


def test_padding_is_never_chosen_and_no_objects_give_numbers(random_state: Callable[..., State]) -> None:
    prior = ObjectMixturePrior(space=SPACE, dimension=2, feature_dimension=6, components=2)
    for parameter in prior.parameters():
        nn.init.normal_(parameter, std=0.3)
    weights = prior(random_state(50, objects=4, real=2)).log_weights.exp()
    assert weights.shape == (50, 8) and not weights[:, 4:].any()
    torch.testing.assert_close(weights.sum(-1), torch.ones(50))
    empty = prior(random_state(3, objects=4, real=0))
    assert empty.log_prob(torch.zeros(3, 2)).isfinite().all() and empty.sample().isfinite().all()
