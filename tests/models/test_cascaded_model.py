from __future__ import annotations

from collections.abc import Callable, Iterator

import pyro
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro import poutine
from pyro.infer import Predictive
from torch import nn

from models.cascaded import CascadedModel
from models.priors.standard import StandardPrior
from models.state import State, Window

SIZES = {"effect_dimension": 5, "motion_dimension": 4, "feature_dimension": 6, "width": 8}
SHAPES = {
    "effect_code": (4, 5),
    "subgoal_centers": (4, 4, 3),
    "subgoal_features": (4, 4, 6),
    "motion_code": (4, 4),
    "actions": (4, 3, 4),
    "next_centers": (4, 3, 4, 3),
    "next_features": (4, 3, 4, 6),
}


@pytest.fixture
def model() -> CascadedModel:
    return CascadedModel(**SIZES)


def trace(model: CascadedModel, window: Window, generate: bool = False) -> poutine.Trace:
    traced = poutine.trace(model).get_trace(window, generate=generate)
    traced.compute_log_prob()
    return traced


def without_plates(names: Iterator[str]) -> set[str]:
    return set(names) - {"windows"}


def test_every_site_has_its_shape_and_counts_once_per_window(
    model: CascadedModel, random_window: Callable[..., Window]
) -> None:
    traced = trace(model, random_window())
    assert {name: tuple(traced.nodes[name]["value"].shape) for name in SHAPES} == SHAPES
    assert {tuple(traced.nodes[name]["log_prob"].shape) for name in SHAPES} == {(4,)}
    assert without_plates(traced.observation_nodes) == set(SHAPES) - {"effect_code", "motion_code"}


def test_windows_that_do_not_count_touch_only_the_dynamics(
    model: CascadedModel, random_window: Callable[..., Window]
) -> None:
    window = random_window()
    assert not window.sequence_mask[1]
    traced = trace(model, window)
    for name in SHAPES:
        dynamics = name.startswith("next")
        assert (traced.nodes[name]["log_prob"][1] != 0) == dynamics
        assert (traced.nodes[name]["log_prob"][[0, 2, 3]] != 0).all()


def test_pairs_that_do_not_count_add_nothing(model: CascadedModel, random_window: Callable[..., Window]) -> None:
    window = random_window()
    none = window._replace(transition_mask=torch.zeros_like(window.transition_mask))
    traced = trace(model, none)
    assert traced.nodes["next_centers"]["log_prob"].abs().max() == 0
    assert traced.nodes["next_features"]["log_prob"].abs().max() == 0


def with_other_padding(window: Window) -> Window:
    states = window.states
    outside = ~states.mask.unsqueeze(-1)
    other = State(torch.where(outside, 7.0, states.centers), torch.where(outside, -3.0, states.features), states.mask)
    return window._replace(states=other)


def test_the_content_of_padding_changes_nothing(model: CascadedModel, random_window: Callable[..., Window]) -> None:
    window = random_window()
    torch.manual_seed(3)
    expected = trace(model, window)
    torch.manual_seed(3)
    traced = trace(model, with_other_padding(window))
    for name in SHAPES:
        assert torch.allclose(traced.nodes[name]["log_prob"], expected.nodes[name]["log_prob"], rtol=1e-5)


def test_generation_reads_only_first_states_and_samples_the_rest(
    model: CascadedModel, random_window: Callable[..., Window]
) -> None:
    window = random_window()
    states = window.states
    unread = torch.full_like(states.centers[:, 1:], float("nan"))
    hidden = Window(
        states._replace(centers=torch.cat([states.centers[:, :1], unread], 1)),
        torch.full_like(window.actions, float("nan")),
        window.transition_mask,
        window.sequence_mask,
    )
    traced = trace(model, hidden, generate=True)
    for name, shape in SHAPES.items():
        assert tuple(traced.nodes[name]["value"].shape) == shape
        assert traced.nodes[name]["value"].isfinite().all()
    steps = {f"next_{part}_{step}" for part in ("centers", "features") for step in (1, 2, 3)}
    assert without_plates(traced.stochastic_nodes) == steps | set(SHAPES) - {"next_centers", "next_features"}


def test_generated_windows_score_the_same_when_observed(
    model: CascadedModel, random_window: Callable[..., Window]
) -> None:
    window = random_window().map(lambda tensor: tensor.double() if tensor.is_floating_point() else tensor)
    window = window._replace(transition_mask=torch.ones(4, 3, dtype=torch.bool))
    generated = trace(model.double(), window, generate=True)
    value = {name: generated.nodes[name]["value"] for name in SHAPES}

    # The dynamics read features of unit length, so observed ones are set to that before the next push.
    first = window.states.step(slice(0, 1))
    centers = torch.cat([first.centers, value["next_centers"]], 1)
    features = torch.cat([first.features, nn.functional.normalize(value["next_features"], dim=-1)], 1)
    observed = Window(State(centers, features, window.states.mask), value["actions"], window.transition_mask, window[3])
    steps = [generated.nodes[f"next_centers_{step}"]["log_prob"] for step in (1, 2, 3)]
    assert torch.allclose(trace(model, observed).nodes["next_centers"]["log_prob"], sum(steps), rtol=1e-10)


def test_predictive_samples_in_parallel(model: CascadedModel, random_window: Callable[..., Window]) -> None:
    window = random_window()
    sampled = Predictive(model, num_samples=6, parallel=True)(window, generate=True)
    for name, shape in SHAPES.items():
        assert sampled[name].shape == (6, *shape)
    assert sampled["subgoal_centers"].std(0).min() > 1e-3


@settings(max_examples=10, deadline=None)
@given(batch=st.lists(st.integers(1, 3), min_size=1, max_size=3), objects=st.integers(1, 5))
def test_planning_shapes(random_state: Callable[..., State], batch: list[int], objects: int) -> None:
    model = CascadedModel(segment_length=2, **SIZES)
    state = random_state(*batch, objects=objects)
    effects = model.effect_prior(state)
    assert (effects.batch_shape, effects.event_shape) == (tuple(batch), (5,))
    c = effects.sample()
    z = model.motion_prior(state, c).sample()
    assert z.shape == (*batch, 4)
    assert model.actions(state, c, z).shape == (*batch, 2, 4)
    for predicted in (model.subgoal(state, c), model.next_state(state, torch.zeros(*batch, 4))):
        assert predicted.batch_shape == tuple(batch)
        assert predicted.mask.shape == (*batch, objects)
        assert predicted.features.shape == (*batch, objects, 6)


def test_planning_methods_are_the_means_of_the_program(
    model: CascadedModel, random_window: Callable[..., Window]
) -> None:
    window = random_window()
    traced = trace(model, window)
    c, z = traced.nodes["effect_code"]["value"], traced.nodes["motion_code"]["value"]
    subgoal, actions = model.subgoal(window.first, c), model.actions(window.first, c, z)
    assert torch.allclose(model.scales.actions(actions).mean, traced.nodes["actions"]["fn"].mean)
    scored = model.scales.centers(subgoal, window.first.mask).log_prob(window.last.centers)
    counted = window.sequence_mask
    assert torch.allclose(scored[counted], traced.nodes["subgoal_centers"]["log_prob"][counted], rtol=1e-5)
    last_push = model.next_state(window.states.step(2), window.actions[:, 2])
    scored = model.scales.features(last_push, window.first.mask).log_prob(window.last.features)
    only_last = window._replace(transition_mask=torch.tensor([False, False, True]).expand(4, 3))
    assert torch.allclose(scored, trace(model, only_last).nodes["next_features"]["log_prob"], rtol=1e-5)


def test_a_prior_is_a_part_like_any_other(random_window: Callable[..., Window]) -> None:
    class Shifted(StandardPrior):
        def forward(self, state, effect_code=None):
            return pyro.distributions.Normal(super().forward(state, effect_code).mean + 9, 1.0).to_event(1)

    model = CascadedModel(**SIZES, effect_prior=Shifted(dimension=5))
    traced = trace(model, random_window())
    assert traced.nodes["effect_code"]["value"].mean() > 7
    assert traced.nodes["motion_code"]["value"].mean() < 2


def test_windows_of_another_shape_are_refused(model: CascadedModel, random_window: Callable[..., Window]) -> None:
    with pytest.raises(ValueError, match="window has 2 pushes; this model was made for 3"):
        model(random_window(steps=2))
    with pytest.raises(ValueError, match=r"one batch \[B\]; got leading dimensions \[1, 4\]"):
        model(random_window().map(lambda tensor: tensor.unsqueeze(0)))
