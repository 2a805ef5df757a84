"""One source of randomness per environment."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch.distributions import (
    Distribution,
    ExpTransform,
    Independent,
    Normal,
    TransformedDistribution,
    Uniform,
)

from models.state import State
from planning.rollouts.sampling import reparameterize, sample_each


def learned_prior(state: State, effect_code: torch.Tensor) -> Distribution:
    """A prior that reads what it is given."""
    mean = state.centers[..., 0, :1] + effect_code
    return Independent(Normal(mean, 0.1), 1)


def test_an_environment_draws_the_same_whoever_else_is_in_the_batch(toy: SimpleNamespace) -> None:
    state = toy.scenes([[(0.1, 0.0)], [(50.0, 0.0)], [(-50.0, 0.0)]]).expand_plans(8)
    codes = torch.randn(3, 8, 16)
    together = sample_each(learned_prior, [state, codes], toy.generators(5, 6, 7))
    for index, seed in enumerate((5, 6, 7)):
        scene = slice(index, index + 1)
        alone = sample_each(learned_prior, [state.scene(scene), codes[scene]], toy.generators(seed))
        assert torch.equal(alone[0], together[index])
    assert (together[1] > 40).all()
    assert (together[2] < -40).all()


def test_draws_equal_those_of_the_global_generator_with_the_same_seed(toy: SimpleNamespace) -> None:
    model, state = toy.PointMass(), toy.scenes([[(0.0, 0.0)]]).expand_plans(32)
    drawn = sample_each(model.effect_prior, [state], toy.generators(11))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(11)
        expected = torch.randn(32, 16)
    assert torch.equal(drawn[0], expected)


def test_generators_move_on_and_the_global_one_does_not(toy: SimpleNamespace) -> None:
    model, state = toy.PointMass(), toy.scenes([[(0.0, 0.0)]]).expand_plans(4)
    before = torch.get_rng_state()
    generator = toy.generators(0)
    first = sample_each(model.effect_prior, [state], generator)
    second = sample_each(model.effect_prior, [state], generator)
    assert not torch.equal(first, second)
    assert torch.equal(torch.get_rng_state(), before)


def test_transformed_normals_are_searched_through_their_transforms() -> None:
    base = Independent(Normal(torch.tensor([1.0, 2.0]), torch.tensor([0.5, 3.0])), 1)
    prior = TransformedDistribution(base, [ExpTransform()])
    noise = torch.tensor([[0.0, 1.0], [-1.0, 2.0]])
    torch.testing.assert_close(reparameterize(prior, noise), torch.tensor([[1.0, 5.0], [0.5, 8.0]]).exp())


def test_a_prior_that_cannot_be_searched_is_named() -> None:
    with pytest.raises(ValueError, match="^codes of a prior of type Uniform can .* shooting and warm_start=false$"):
        reparameterize(Uniform(0.0, 1.0), torch.zeros(3))
