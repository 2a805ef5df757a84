"""Samples of whatever prior the model has, one source of randomness per environment."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch import nn
from torch.distributions import ExpTransform, Independent, Normal, TransformedDistribution, Uniform

from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.priors.conditional import ConditionalPrior
from cavin_pyro.models.priors.flow import FlowPrior
from cavin_pyro.models.priors.mixture import ObjectMixturePrior
from cavin_pyro.models.priors.standard import StandardPrior
from cavin_pyro.models.state import State
from cavin_pyro.planning import CavinPlanner, Plan
from cavin_pyro.planning.sampling import noise_each, reparameterize, sample_codes

each_prior = pytest.mark.parametrize("kind", [StandardPrior, ConditionalPrior, FlowPrior, ObjectMixturePrior])


def model_with(kind: type) -> CascadedModel:
    torch.manual_seed(0)
    model = CascadedModel(
        space=SPACE,
        effect_dimension=5,
        motion_dimension=4,
        feature_dimension=1,
        width=8,
        effect_prior=kind(space=SPACE, dimension=5, feature_dimension=1),
        motion_prior=kind(space=SPACE, dimension=4, feature_dimension=1, effect_dimension=5),
    )
    for name, parameter in model.named_parameters():
        if name.startswith("prior"):
            nn.init.normal_(parameter, std=0.1)
    return model


def scenes(toy: SimpleNamespace) -> State:
    return toy.scenes([[(0.5, 0.1), (0.7, -0.1)], [(0.4, -0.2), (0.6, 0.3)]], [1.0, 1.0])


def plan_with(
    toy: SimpleNamespace, model: CascadedModel, state: State, *seeds: int, horizon: str = "first_segment"
) -> Plan:
    planner = CavinPlanner(model, samples=32, horizon=9, motion_horizon=horizon)
    return planner.plan(state, reward=toy.GoalDisc((0.8, 0.0)), generators=toy.generators(*seeds))


@each_prior
@pytest.mark.parametrize("horizon", ["first_segment", "full_horizon"])
def test_a_plan_comes_out_and_again_from_the_same_seed(kind: type, horizon: str, toy: SimpleNamespace) -> None:
    models = [model_with(kind) for _ in range(2)]
    global_state = torch.get_rng_state()
    plans = [plan_with(toy, one, scenes(toy), 3, 4, horizon=horizon) for one in models]
    assert torch.equal(torch.get_rng_state(), global_state)
    assert plans[0].actions.shape == (2, 3, 4)
    assert plans[0].effect_codes.shape == (2, 3, 5)
    assert plans[0].actions.isfinite().all()
    assert torch.equal(plans[0].actions, plans[1].actions)
    other = plan_with(toy, models[0], scenes(toy), 5, 6, horizon=horizon)
    assert not torch.equal(plans[0].actions, other.actions)


@each_prior
def test_noise_stands_for_the_code_that_the_prior_draws_with_it(kind: type, toy: SimpleNamespace) -> None:
    model, state = model_with(kind), scenes(toy).expand_plans(6)
    noise = [noise_each((6, 5), toy.generators(3, 4)), noise_each((6, 4), toy.generators(5, 6))]
    effects = sample_codes(model.effect_prior, [state], noise[0])
    torch.testing.assert_close(effects, sample_codes(model.effect_prior, [state], None, toy.generators(3, 4)))
    motions = sample_codes(model.motion_prior, [state, effects], noise[1])
    torch.testing.assert_close(motions, sample_codes(model.motion_prior, [state, effects], None, toy.generators(5, 6)))


def test_transformed_normals_are_searched_through_their_transforms() -> None:
    base = Independent(Normal(torch.tensor([1.0, 2.0]), torch.tensor([0.5, 3.0])), 1)
    prior = TransformedDistribution(base, [ExpTransform()])
    noise = torch.tensor([[0.0, 1.0], [-1.0, 2.0]])
    torch.testing.assert_close(reparameterize(prior, noise), torch.tensor([[1.0, 5.0], [0.5, 8.0]]).exp())


def test_a_prior_that_cannot_be_searched_is_named() -> None:
    with pytest.raises(ValueError, match="^codes of a prior of type Uniform can .* shooting and early_stopping=false$"):
        reparameterize(Uniform(0.0, 1.0), torch.zeros(3))
