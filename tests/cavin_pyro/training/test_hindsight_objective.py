"""How far subgoals lie from what motions attain: the term, its gradient, and what it brings."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from pyro.infer import Trace_ELBO
from torch import Tensor

from cavin_pyro.training.hindsight import OUTCOMES, hindsight_loss
from cavin_pyro.training.objectives import Objective
from guides.cascaded import CascadedGuide
from models.cascaded import CascadedModel
from models.flat import FlatModel
from models.state import State, Window
from tests.cavin_pyro.training.small_cascade import model_with

MOTIONS = 5


def reference() -> CascadedModel:
    """A model with another h."""
    model = model_with()
    with torch.no_grad():
        model.meta_dynamics.change.head.bias[:2] = torch.tensor([2.0, 0.5])
    return model


def loss_of(model: CascadedModel, window: Window, **options: int) -> Tensor:
    other = reference()
    torch.manual_seed(7)
    return hindsight_loss(model, window, other, motions=MOTIONS, **options)


def scene(state: State, number: int) -> State:
    return state.map(lambda field: field[number : number + 1])


def outcomes(model: CascadedModel, start: State, pushes: Tensor, uniform: Tensor) -> list[State]:
    """The states that f samples for one motion, outcome by outcome: `pushes: [T, 4]`, `uniform: [O, T, M, 2]`."""
    ends = []
    for own in uniform:
        state = start
        for push, numbers in zip(pushes, own, strict=True):
            state = model.sampled_next_state(state, push[None], numbers[None])
        ends.append(state)
    return ends


def distance(state: State, subgoal: State, real: Tensor) -> Tensor:
    return (state.centers - subgoal.centers)[0, real].norm(dim=-1).sum()


def by_hand(model: CascadedModel, window: Window) -> float:
    """The term, window by window and motion by motion."""
    first = window.first
    count, objects = first.mask.shape
    other = reference()
    torch.manual_seed(7)
    effect = model.effect_prior(first).sample()
    here = first.expand_plans(1)
    codes = model.motion_prior(here, effect.unsqueeze(-2)).expand((count, MOTIONS)).sample()
    shape = (count, 1, OUTCOMES, window.segment_length, objects, 2)
    choosing = torch.rand(shape, dtype=torch.float64)
    attaining = torch.rand(shape, dtype=torch.float64)[:, 0]
    total = 0.0
    for number in range(count):
        start = scene(first, number)
        real = start.mask[0]
        subgoal = model.subgoal(start, effect[number][None])
        wanted = other.subgoal(start, effect[number][None])
        motions = [model.actions(start, effect[number][None], z[None])[0] for z in codes[number]]

        expected = [
            sum(distance(state, wanted, real) for state in outcomes(model, start, pushes, choosing[number, 0]))
            for pushes in motions
        ]
        chosen = motions[int(torch.stack(expected).argmin())]
        for state in outcomes(model, start, chosen, attaining[number]):
            turned = (state.features - subgoal.features)[0, real].norm(dim=-1).sum()
            total += (distance(state, subgoal, real) / 0.005 + turned / 0.1).item() / OUTCOMES
    return total


def test_it_is_the_distance_to_what_the_motion_attains_that_is_closest_in_expectation(small_window: Window) -> None:
    model = model_with()
    with torch.no_grad():
        assert loss_of(model, small_window).item() == pytest.approx(by_hand(model, small_window), rel=1e-3)


def test_its_gradient_reaches_h_alone(small_window: Window) -> None:
    model = model_with()
    loss_of(model, small_window).backward()
    reached = {name.split(".")[0] for name, one in model.named_parameters() if one.grad is not None and one.grad.any()}
    assert reached <= {"meta_dynamics", "encoder"}
    assert "meta_dynamics" in reached


def test_training_on_it_brings_subgoals_to_what_is_attained(small_window: Window) -> None:
    """f moves nothing here, so that no motion reaches a subgoal that moves something."""
    model = model_with()
    with torch.no_grad():
        model.dynamics.change.head.weight.zero_()
        model.dynamics.change.head.bias.fill_(-20.0)  # the gate is closed
        model.meta_dynamics.change.head.bias[:2] = torch.tensor([3.0, 1.0])  # h moves everything
    first = small_window.first

    def moved() -> float:
        torch.manual_seed(1)
        with torch.no_grad():
            code = model.effect_prior(first).sample()
            return (model.subgoal(first, code).centers - first.centers)[first.mask].norm(dim=-1).mean().item()

    before, asked = moved(), deepcopy(model)
    optimizer = torch.optim.Adam(model.meta_dynamics.parameters(), lr=0.02)
    for _ in range(150):
        optimizer.zero_grad()
        hindsight_loss(model, small_window, asked, motions=4).backward()
        optimizer.step()
    assert before > 0.1
    assert moved() < 0.02  # f's samples scatter by 1 cm


def test_effects_ask_for_what_h_said_as_training_began(small_window: Window) -> None:
    """By h as it is now, the choice would follow h, and subgoals would shrink until nothing moves."""
    model = model_with()
    bound = Objective(Trace_ELBO(), hindsight_weight=1.0).bind(model, CascadedGuide(model, width=8).double())
    torch.manual_seed(7)
    before = bound.terms_of_model(small_window)["hindsight"].item()
    with torch.no_grad():
        asked = deepcopy(model)
        model.meta_dynamics.change.head.bias[:2] = torch.tensor([2.0, 0.5])
    torch.manual_seed(7)
    after = bound.terms_of_model(small_window)["hindsight"].item()
    torch.manual_seed(7)
    assert after == hindsight_loss(model, small_window, asked).item()
    assert after != before
    assert all(id(one) != id(two) for one in bound.parameters() for two in asked.parameters())


def test_a_model_without_subgoals_is_refused() -> None:
    objective = Objective(Trace_ELBO(), hindsight_weight=1.0)
    with pytest.raises(ValueError, match="FlatModel has none: choose model=cascaded"):
        objective.check(FlatModel(motion_dimension=4, feature_dimension=6, width=8))
    objective.check(model_with())


def test_a_weight_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match=r"objective.hindsight_weight must be 0 or more, not -1"):
        Objective(Trace_ELBO(), hindsight_weight=-1.0)
