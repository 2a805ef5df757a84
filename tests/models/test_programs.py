"""The four programs: sites, masks, generation, and what planners call. ELBOs are in `tests/guides`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro import distributions, poutine
from torch import Tensor, nn

from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.dynamics_only import DynamicsModel
from cavin_pyro.models.flat import FlatModel
from cavin_pyro.models.likelihoods import LikelihoodScales, PredictedScales
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.contact.dynamics import ContactDynamics
from cavin_pyro.models.networks.outline import Outline
from cavin_pyro.models.priors.standard import StandardPrior
from cavin_pyro.models.single_latent import SingleLatentModel
from cavin_pyro.models.state import State, Window

SIZES = {"space": SPACE, "feature_dimension": 6, "width": 8}
TRANSITIONS = {"next_centers": (4, 3, 4, 3), "next_features": (4, 3, 4, 6)}
ACTIONS = {"actions": (4, 3, 4)}
SUBGOAL = {"subgoal_centers": (4, 4, 3), "subgoal_features": (4, 4, 6)}
SITES: dict[type[Model], dict[str, tuple[int, ...]]] = {
    CascadedModel: {"effect_code": (4, 16)} | SUBGOAL | {"motion_code": (4, 16)} | ACTIONS | TRANSITIONS,
    SingleLatentModel: {"effect_code": (4, 32)} | SUBGOAL | ACTIONS | TRANSITIONS,
    FlatModel: {"motion_code": (4, 32)} | ACTIONS | TRANSITIONS,
    DynamicsModel: TRANSITIONS,
}
every_model = pytest.mark.parametrize("kind", SITES, ids=lambda kind: kind.__name__)


def trace(model: Any, window: Window) -> poutine.Trace:
    traced = poutine.trace(model).get_trace(window)
    traced.compute_log_prob()
    return traced


def values_of(generated: poutine.Trace) -> dict[str, Tensor]:
    """Of every sampled site, and those of f for all pushes at once."""
    values = {name: generated.nodes[name]["value"] for name in generated.stochastic_nodes}
    return values | {name: torch.stack([values[f"{name}_{push}"] for push in (1, 2, 3)], 1) for name in TRANSITIONS}


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda m, s, c, z, a: m.next_state(s, a[..., 1:]), r"action must be a tensor \[..., 4\], not \[4, 3\]"),
        (lambda m, s, c, z, a: m.next_state(None, a), r"centers of a state must be a tensor .*, not None"),
        (lambda m, s, c, z, a: m.subgoal(s, c[..., 1:]), "effect_code must be a tensor"),
        (lambda m, s, c, z, a: m.actions(s, c, None), "motion_code must be a tensor .*, not None"),
        (lambda m, s, c, z, a: m.motion_prior(s, c[..., 1:]), "effect_code must be a tensor"),
        (lambda m, s, c, z, a: m.effect_prior(None), "centers of a state must be"),
        (lambda m, s, c, z, a: m.subgoal(s._replace(centers=s.centers[..., 1:]), c), "centers of a state must"),
    ],
)
def test_a_tensor_of_another_size_is_named(call: Callable[..., Any], said: str, random_state: Callable) -> None:
    model, given = CascadedModel(**SIZES), (random_state(4), torch.zeros(4, 16), torch.zeros(4, 16), torch.zeros(4, 4))
    model.next_state(given[0], given[3])
    with pytest.raises(ValueError, match=said):
        call(model, *given)


def test_the_readme_shows_the_sites_of_the_program_in_their_order() -> None:
    page = (Path(__file__).resolve().parents[2] / "README.md").read_text()
    assert re.findall(r'pyro\.sample\("(\w+)"', page) == list(SITES[CascadedModel])


@every_model
def test_sites_are_those_of_the_docstring_and_masks_take_them_out(
    kind: type[Model], random_window: Callable[..., Window]
) -> None:
    window, shapes = random_window(), SITES[kind]
    traced = trace(kind(**SIZES), window)
    assert [name for name in traced.nodes if name in shapes] == list(shapes)
    assert {name: tuple(traced.nodes[name]["value"].shape) for name in shapes} == shapes
    assert set(traced.nodes) - set(shapes) == {"_INPUT", "_RETURN", "windows"}
    for name in shapes:
        scores = traced.nodes[name]["log_prob"]
        assert scores.shape == (4,) and (scores[[0, 2, 3]] != 0).all()
        assert (scores[1] != 0) == (name in TRANSITIONS)  # that window does not count
    none = window._replace(transition_mask=torch.zeros_like(window.transition_mask))
    for name in TRANSITIONS:
        assert not trace(kind(**SIZES), none).nodes[name]["log_prob"].any()


@every_model
def test_generation_reads_only_first_states_and_given_actions(
    kind: type[Model], random_window: Callable[..., Window]
) -> None:
    window = random_window()
    states = window.states
    unread = torch.full_like(states.centers[:, 1:], math.nan)
    hidden = window._replace(states=states._replace(centers=torch.cat([states.centers[:, :1], unread], 1)))
    if kind is not DynamicsModel:
        hidden = hidden._replace(actions=torch.full_like(window.actions, math.nan))
    traced = trace(kind(**SIZES).generate, hidden)
    values = values_of(traced)
    assert {name: tuple(values[name].shape) for name in SITES[kind]} == SITES[kind]
    assert all(value.isfinite().all() for value in values.values()) and not traced.observation_nodes


def test_generated_windows_score_the_same_when_observed(random_window: Callable[..., Window]) -> None:
    window = random_window().map(lambda tensor: tensor.double() if tensor.is_floating_point() else tensor)
    window = window._replace(transition_mask=torch.ones(4, 3, dtype=torch.bool))
    model = CascadedModel(**SIZES).double()
    generated = trace(model.generate, window)
    value = values_of(generated)
    # The dynamics read features of unit length, so observed ones are set to that before the next push.
    first = window.states.step(slice(0, 1))
    centers = torch.cat([first.centers, value["next_centers"]], 1)
    features = torch.cat([first.features, nn.functional.normalize(value["next_features"], dim=-1)], 1)
    observed = Window(State(centers, features, window.states.mask), value["actions"], window.transition_mask, window[3])
    steps = [generated.nodes[f"next_centers_{step}"]["log_prob"] for step in (1, 2, 3)]
    assert torch.allclose(trace(model, observed).nodes["next_centers"]["log_prob"], sum(steps), rtol=1e-10)


@every_model
def test_windows_of_another_shape_are_refused(kind: type[Model], random_window: Callable[..., Window]) -> None:
    with pytest.raises(ValueError, match="window has 2 actions; this model was made for 3"):
        kind(**SIZES)(random_window(steps=2))
    for change in (lambda tensor: tensor.unsqueeze(0), lambda tensor: tensor[:0]):
        with pytest.raises(ValueError, match=r"one batch \[B\] with states \[B, T \+ 1\], not "):
            kind(**SIZES)(random_window().map(change))
    with pytest.raises(ValueError, match=r"actions of a window must be a tensor \[..., 4\], not \[4, 3, 2\]"):
        kind(**SIZES)((window := random_window())._replace(actions=window.actions[..., :2]))


@every_model
def test_a_model_offers_exactly_what_its_codes_declare(kind: type[Model]) -> None:
    model = kind(**SIZES)
    effect, motion = ("effect_dimension", "effect_prior", "subgoal"), ("motion_dimension", "motion_prior")
    for code, parts in {"effect_code": effect, "motion_code": motion}.items():
        assert all(hasattr(model, part) == (code in model.codes) for part in parts)
    assert hasattr(model, "actions") == bool(model.codes)
    assert {"maximum_objects": 8} and kind(**SIZES, maximum_objects=8).encoder.neighbours == 7
    assert kind(**SIZES, neighbours=2).dynamics.neighbours == 2


@every_model
def test_planning_methods_are_the_means_of_the_program(kind: type[Model], random_window: Callable[..., Window]) -> None:
    window, model = random_window(), kind(**SIZES)
    nodes = trace(model, window).nodes
    codes = {name: nodes[name]["value"] if name in nodes else None for name in ("effect_code", "motion_code")}
    first, counted = window.first, window.sequence_mask
    if "actions" in nodes:
        assert torch.allclose(model.actions(first, **codes), nodes["actions"]["fn"].mean, atol=1e-6)
    if "subgoal_centers" in nodes:
        scored = model.scales.centers(model.subgoal(first, codes["effect_code"]), first.mask)
        scored = scored.log_prob(window.last.centers)
        assert torch.allclose(scored[counted], nodes["subgoal_centers"]["log_prob"][counted], rtol=1e-5)
    last_push = model.next_state(window.states.step(2), window.actions[:, 2])
    scored = model.scales.features(last_push, first.mask).log_prob(window.last.features)
    only_last = window._replace(transition_mask=torch.tensor([False, False, True]).expand(4, 3))
    assert torch.allclose(scored, trace(model, only_last).nodes["next_features"]["log_prob"], rtol=1e-5)


def planned(model: Model, state: State, codes: dict[str, Any], action: Tensor) -> dict[str, Tensor]:
    """All that a planner can ask of a model, with the keywords that planners use."""
    answers = {"next_state": model.next_state(state, action).centers}
    if "effect_code" in model.codes:
        answers["subgoal"] = model.subgoal(state, codes["effect_code"]).centers
    if model.codes:
        answers["actions"] = model.actions(state, **codes)
    return answers


@every_model
@settings(max_examples=6, deadline=None)
@given(batch=st.lists(st.integers(1, 3), min_size=1, max_size=2), order=st.permutations(range(4)))
def test_planning_broadcasts_and_ignores_the_order_of_objects(
    random_state: Callable[..., State], kind: type[Model], batch: list[int], order: list[int]
) -> None:
    model = kind(segment_length=2, **SIZES).double()
    state = random_state(*batch, objects=4, real=3).map(lambda field: field.double() if field.dtype != bool else field)
    state = State(state.centers, state.features, state.mask.bool())
    effect = model.effect_prior(state).sample() if "effect_code" in model.codes else None
    motion = model.motion_prior(state, effect_code=effect).sample() if "motion_code" in model.codes else None
    codes, action = {"effect_code": effect, "motion_code": motion}, torch.zeros(*batch, 4, dtype=torch.float64)
    asked = planned(model, state, codes, action)
    shuffled = State(state.centers[..., order, :], state.features[..., order, :], state.mask[..., order])
    # Many plans in one state: [..., 1] with codes and actions [..., 7].
    many = planned(
        model,
        state.map(lambda field: field.unsqueeze(len(batch))),
        {name: None if code is None else code.unsqueeze(-2).expand(*batch, 7, -1) for name, code in codes.items()},
        action.unsqueeze(-2).expand(*batch, 7, 4),
    )
    others = planned(model, shuffled, codes, action)
    for name, value in asked.items():
        same = value if name == "actions" else value[..., order, :]
        assert value.shape == (*batch, *((2, 4) if name == "actions" else (4, 3)))
        assert torch.allclose(others[name], same, atol=1e-12)
        repeated = value.unsqueeze(len(batch)).expand(*batch, 7, *value.shape[len(batch) :])
        assert torch.allclose(many[name], repeated, atol=1e-12)


def test_counterparts_of_the_baselines_are_the_networks_of_the_cascade() -> None:
    """Same layers, but for the width of a code and what nothing reads any more."""

    def layers(model: nn.Module) -> dict[str, tuple[int, ...]]:
        return {name: tuple(parameter.shape) for name, parameter in model.named_parameters()}

    cascade = layers(CascadedModel(effect_dimension=32, motion_dimension=32, **SIZES))
    single, flat, dynamics = (layers(kind(**SIZES)) for kind in (SingleLatentModel, FlatModel, DynamicsModel))
    assert set(cascade) - set(single) == {"action_generator.transform.weight", "action_generator.transform.bias"}
    read_first = {f"action_generator.{part}.0.0.weight" for part in ("starts", "motions")}  # the pool instead of z
    assert {name for name in single if single[name] != cascade[name]} == read_first
    assert not {name for name in cascade if name not in flat and not name.startswith("meta_dynamics.")}
    assert all(flat[name] == (cascade[name] if name in cascade else cascade[f"meta_dynamics.{name}"]) for name in flat)
    assert set(dynamics) == {name for name in cascade if name.startswith(("encoder.", "dynamics."))}


def test_scales_and_priors_are_parts_like_any_other(random_window: Callable[..., Window]) -> None:
    class Shifted(StandardPrior):
        def forward(self, state: State, effect_code: Tensor | None = None) -> Any:
            return distributions.Normal(super().forward(state, effect_code).mean + 9, 1.0).to_event(1)

    scales = LikelihoodScales(SPACE)
    object.__setattr__(scales, "center", torch.tensor(0.01, requires_grad=True))  # as a class of one's own may learn it
    model = CascadedModel(scales=scales, effect_prior=Shifted(dimension=16), **SIZES)
    traced = trace(model, random_window())
    assert traced.nodes["effect_code"]["value"].mean() > 7 > traced.nodes["motion_code"]["value"].mean()
    traced.log_prob_sum().backward()
    assert scales.center.grad.abs() > 0


def contact_model(scales: LikelihoodScales) -> tuple[CascadedModel, Window]:
    """With an f that predicts scales, which it needs for `PredictedScales` alone."""
    torch.manual_seed(0)
    model = CascadedModel(space=SPACE, width=8, scales=scales, dynamics=ContactDynamics(object_width=8, pair_width=4))
    clouds, mask = 0.03 * torch.randn(3, 4, 2, 32, 3), torch.ones(3, 4, 2, dtype=torch.bool)
    centers = torch.tensor([0.5, 0.0, 0.02]) + 0.1 * torch.randn(3, 4, 2, 3)
    counted = mask[:, :3, 0]
    return model, Window(State(centers, Outline()(clouds), mask), 2 * torch.rand(3, 3, 4) - 1, counted, counted[:, 0])


@pytest.mark.parametrize("scales", [PredictedScales(SPACE), LikelihoodScales(SPACE)])
def test_f_is_scored_by_students_t_with_its_own_scales_or_by_fixed_ones(scales: LikelihoodScales) -> None:
    model, seen = contact_model(scales)
    site = trace(model, seen).nodes["next_centers"]
    mean, own = model.dynamics.outcome(seen.states.step(slice(0, -1)), None, seen.actions)
    expected: Any = distributions.Normal(mean.centers, 0.01).to_event(1)
    if isinstance(scales, PredictedScales):
        matrices = own[..., :1, None] * torch.eye(3)
        expected = distributions.MultivariateStudentT(torch.tensor(3.0), mean.centers, matrices)
    scored = expected.log_prob(seen.states.centers[:, 1:]).sum((-1, -2))
    assert torch.allclose(site["fn"].log_prob(site["value"]), scored, rtol=1e-4, atol=1e-3)
    trace(model.generate, seen)
    with pytest.raises(ValueError, match="scales=predicted needs an f that predicts them"):
        CascadedModel(scales=PredictedScales(SPACE), **SIZES)
