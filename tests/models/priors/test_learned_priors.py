from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pyro.distributions import Normal
from torch import Tensor, nn
from torch.distributions import kl_divergence

from models.priors.conditional import ConditionalPrior
from models.priors.flow import FlowPrior
from models.priors.mixture import ObjectMixturePrior
from models.state import State

SIZES = {"dimension": 4, "feature_dimension": 6, "width": 8}
PRIORS = (ConditionalPrior, FlowPrior, ObjectMixturePrior)
each_prior = pytest.mark.parametrize("kind", PRIORS)


def randomized(prior: nn.Module) -> nn.Module:
    """In float64, with weights far from where training begins."""
    for parameter in prior.double().parameters():
        nn.init.normal_(parameter, std=0.3)
    return prior


def double(state: State) -> State:
    return state.map(lambda field: field.double() if field.is_floating_point() else field)


@each_prior
@pytest.mark.parametrize("effect_dimension", [None, 5])
def test_training_begins_at_the_standard_normal(
    kind: type, effect_dimension: int | None, random_state: Callable[..., State]
) -> None:
    prior = kind(**SIZES, effect_dimension=effect_dimension)
    codes = 3 * torch.randn(7, 4)
    distribution = prior(random_state(7), None if effect_dimension is None else torch.randn(7, 5))
    assert (distribution.batch_shape, distribution.event_shape) == ((7,), (4,))
    # The components of a mixture are not quite equal at first, or they would stay equal.
    tolerance = 1e-2 if kind is ObjectMixturePrior else 1e-5
    assert torch.allclose(distribution.log_prob(codes), Normal(0.0, 1.0).log_prob(codes).sum(-1), rtol=tolerance)


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
    one_code = prior(state, effect_code[(0,) * (len(batch) + 1)])
    assert one_code.batch_shape == (*batch,)


@each_prior
def test_the_state_and_the_effect_matter(kind: type, random_state: Callable[..., State]) -> None:
    prior, state = randomized(kind(**SIZES, effect_dimension=5)), double(random_state(2))
    effect_code, codes = torch.randn(2, 5).double(), torch.randn(2, 4).double()
    expected = prior(state, effect_code).log_prob(codes)
    moved = state._replace(centers=state.centers + 0.05)
    turned = state._replace(features=-state.features)
    for other in (prior(moved, effect_code), prior(turned, effect_code), prior(state, effect_code + 1)):
        assert not torch.allclose(other.log_prob(codes), expected, atol=1e-3)


@each_prior
def test_samples_depend_on_the_global_seed_alone(kind: type, random_state: Callable[..., State]) -> None:
    distribution = randomized(kind(**SIZES))(double(random_state(6)))
    repeats = []
    for _ in range(2):
        torch.manual_seed(1)
        repeats.append(distribution.sample())
    assert repeats[0].shape == (6, 4)
    assert torch.equal(*repeats)
    assert (repeats[0][1:] != repeats[0][:-1]).all()


def test_the_divergence_from_a_conditional_prior_is_that_of_two_gaussians(random_state: Callable[..., State]) -> None:
    prior = randomized(ConditionalPrior(**SIZES))
    p = prior(double(random_state(3)))
    m, s = p.mean, p.stddev
    mean, scale = torch.randn(2, 3, 4).double().unbind()
    scale = scale.exp()
    formula = (s.log() - scale.log() + (scale**2 + (mean - m) ** 2) / (2 * s**2) - 0.5).sum(-1)
    assert torch.allclose(kl_divergence(Normal(mean, scale).to_event(1), p), formula, rtol=1e-12)


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


@each_prior
def test_an_effect_code_is_given_where_one_is_wanted(kind: type, random_state: Callable[..., State]) -> None:
    with pytest.raises(ValueError, match="this prior needs the effect code"):
        kind(**SIZES, effect_dimension=5)(random_state(2))
    with pytest.raises(ValueError, match="this prior takes no effect code"):
        kind(**SIZES)(random_state(2), torch.randn(2, 5))
