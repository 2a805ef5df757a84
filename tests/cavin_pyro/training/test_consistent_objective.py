"""How likely motions of the prior reach the subgoal: the term, its gradient, and what it brings."""

from __future__ import annotations

import math

import pytest
import torch
from pyro.infer import Trace_ELBO
from torch import Tensor

from cavin_pyro.training.consistency import consistency_loss
from cavin_pyro.training.objectives import Objective
from models.cascaded import CascadedModel
from models.flat import FlatModel
from models.priors.conditional import ConditionalPrior
from models.priors.flow import FlowPrior
from models.priors.mixture import ObjectMixturePrior
from models.state import State, Window
from tests.cavin_pyro.training.small_cascade import SIZES, model_with

MOTIONS = 3


def samples(model: CascadedModel, window: Window) -> tuple[Tensor, Tensor]:
    """The codes that the term samples first after `torch.manual_seed(7)`: c `[B, C]`, z `[B, K, Z]`."""
    torch.manual_seed(7)
    with torch.no_grad():
        effect = model.effect_prior(window.first).sample()
        here, each = window.first.expand_plans(1), effect.unsqueeze(-2)
        motion = model.motion_prior(here, each).expand((len(effect), MOTIONS)).sample()
    return effect, motion


def scene(state: State, number: int) -> State:
    return state.map(lambda field: field[number : number + 1])


def by_hand(model: CascadedModel, window: Window) -> Tensor:
    """The densities of `reached`, window by window and motion by motion: `[B, K]`."""
    effect, motion = samples(model, window)
    rows = []
    for number, (c, codes) in enumerate(zip(effect, motion, strict=True)):
        start = scene(window.first, number)
        subgoal = model.subgoal(start, c[None])
        for z in codes:
            state = start
            for push in model.actions(start, c[None], z[None])[0]:
                state = model.next_state(state, push[None])
            far = (state.centers - subgoal.centers)[0, start.mask[0], :2]
            least = math.exp(-(0.08**2) / (2 * 0.02**2))
            rows.append((torch.exp(-(far**2).sum() / (2 * 0.02**2)) + least) / (1 + least))
    return torch.stack(rows).view(len(effect), MOTIONS)


def loss_of(model: CascadedModel, window: Window, **options: int) -> Tensor:
    torch.manual_seed(7)
    return consistency_loss(model, window, motions=MOTIONS, **options)


def test_it_is_minus_the_logarithm_of_how_likely_the_subgoal_is_reached(small_window: Window) -> None:
    model = model_with()
    expected = -by_hand(model, small_window).mean(-1).log().sum()
    assert loss_of(model, small_window).item() == pytest.approx(expected.item(), rel=1e-9)


@pytest.mark.parametrize("kind", [ConditionalPrior, FlowPrior, ObjectMixturePrior])
def test_its_gradient_weights_each_motion_by_how_near_it_comes(kind: type, small_window: Window) -> None:
    model = model_with(kind)
    effect, motion = samples(model, small_window)
    density = by_hand(model, small_window).detach()
    here, each = small_window.first.expand_plans(1), effect.unsqueeze(-2)
    log_prior = model.motion_prior(here, each).expand((len(effect), MOTIONS)).log_prob(motion)
    surrogate = -(density / density.sum(-1, keepdim=True) * log_prior).sum()
    wanted = torch.autograd.grad(surrogate, list(model.prior_of_motions.parameters()))
    found = torch.autograd.grad(loss_of(model, small_window), list(model.parameters()), allow_unused=True)
    reached = {name: one for (name, _), one in zip(model.named_parameters(), found, strict=True) if one is not None}
    assert {name.split(".")[0] for name in reached} == {"prior_of_motions"}
    for mine, theirs in zip(reached.values(), wanted, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-8, atol=1e-10)


def test_training_on_it_makes_sampled_motions_come_nearer(small_window: Window) -> None:
    """With h replaced by f along a motion that the prior seldom samples, so that the optimum is known."""
    model = model_with()
    wanted = torch.tensor([2.5, -2.5, 2.0, 2.0], dtype=torch.float64)

    def subgoal(state: State, effect_code: Tensor) -> State:
        for push in model.actions(state, effect_code, wanted).unbind(-2):
            state = model.next_state(state, push)
        return state

    model.subgoal = subgoal  # type: ignore[method-assign]
    for parameter in model.parameters():  # a network without training hardly moves anything: let f and g differ by z
        parameter.requires_grad_(False)
    model.dynamics.change.head.bias[:3] = torch.tensor([3.0, 0.0, 0.0], dtype=torch.float64)
    model.dynamics.change.head.weight[:3] *= 20
    model.prior_of_motions.requires_grad_(True)

    def far() -> float:
        torch.manual_seed(1)
        with torch.no_grad():
            return sum(consistency_loss(model, small_window, motions=1).item() for _ in range(20))

    before = far()
    optimizer = torch.optim.Adam(model.prior_of_motions.parameters(), lr=0.02)
    for _ in range(150):
        optimizer.zero_grad()
        consistency_loss(model, small_window, motions=16).backward()
        optimizer.step()
    assert far() < 0.5 * before


def test_a_model_without_such_a_prior_is_refused() -> None:
    objective = Objective(Trace_ELBO(), consistency_weight=1.0)
    with pytest.raises(ValueError, match="FlatModel has none: choose model=cascaded"):
        objective.check(FlatModel(motion_dimension=4, feature_dimension=6, width=8))
    with pytest.raises(ValueError, match="prior=standard has nothing to fit: choose prior=conditional, mixture or"):
        objective.check(CascadedModel(**SIZES))
    objective.check(model_with())


def test_a_weight_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match=r"objective.consistency_weight must be 0 or more, not -1"):
        Objective(Trace_ELBO(), consistency_weight=-1.0)
