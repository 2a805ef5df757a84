"""The programs of SeCTAR, CVAE-MPC and MPC; what the cascade shares with them is in `test_cascaded_model.py`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro import distributions, poutine
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from models.cascaded import CascadedModel
from models.dynamics_only import DynamicsModel
from models.flat import FlatModel
from models.likelihoods import LikelihoodScales
from models.model import Model
from models.single_latent import SingleLatentModel
from models.state import State, Window

SIZES = {"feature_dimension": 6, "width": 8}
TRANSITIONS = {"next_centers": (4, 3, 4, 3), "next_features": (4, 3, 4, 6)}
ACTIONS = {"actions": (4, 3, 4)}
SUBGOAL = {"subgoal_centers": (4, 4, 3), "subgoal_features": (4, 4, 6)}
SITES = {
    SingleLatentModel: {"effect_code": (4, 32)} | SUBGOAL | ACTIONS | TRANSITIONS,
    FlatModel: {"motion_code": (4, 32)} | ACTIONS | TRANSITIONS,
    DynamicsModel: TRANSITIONS,
}
every_model = pytest.mark.parametrize("kind", SITES, ids=lambda kind: kind.__name__)


def trace(model: Model, window: Window, generate: bool = False) -> poutine.Trace:
    traced = poutine.trace(model).get_trace(window, generate=generate)
    traced.compute_log_prob()
    return traced


@every_model
def test_sites_are_those_of_the_docstring_and_count_once_per_window(
    kind: type[Model], random_window: Callable[..., Window]
) -> None:
    traced = trace(kind(**SIZES), random_window())
    shapes = SITES[kind]
    assert [name for name in traced.nodes if name in shapes] == list(shapes)
    assert {name: tuple(traced.nodes[name]["value"].shape) for name in shapes} == shapes
    assert {tuple(traced.nodes[name]["log_prob"].shape) for name in shapes} == {(4,)}
    assert set(traced.nodes) - set(shapes) == {"_INPUT", "_RETURN", "windows"}


@every_model
def test_windows_that_do_not_count_touch_only_the_dynamics(
    kind: type[Model], random_window: Callable[..., Window]
) -> None:
    window = random_window()
    assert not window.sequence_mask[1]
    traced = trace(kind(**SIZES), window)
    for name in SITES[kind]:
        assert (traced.nodes[name]["log_prob"][1] != 0) == (name in TRANSITIONS)
        assert (traced.nodes[name]["log_prob"][[0, 2, 3]] != 0).all()


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
    traced = trace(kind(**SIZES), hidden, generate=True)
    for name, shape in SITES[kind].items():
        assert tuple(traced.nodes[name]["value"].shape) == shape
        assert traced.nodes[name]["value"].isfinite().all()
    assert set(traced.observation_nodes) == set(TRANSITIONS)  # records of what was sampled push by push


def test_the_dynamics_alone_sample_the_outcomes_of_given_pushes(random_window: Callable[..., Window]) -> None:
    window = random_window()
    model = DynamicsModel(**SIZES, scales=LikelihoodScales(center=1e-6))
    sampled = trace(model, window, generate=True).nodes["next_centers"]["value"]
    expected = model.next_state(window.first, window.actions[:, 0]).centers
    real = window.first.mask
    assert torch.allclose(sampled[:, 0][real], expected[real], atol=1e-5)


@every_model
def test_windows_of_another_shape_are_refused(kind: type[Model], random_window: Callable[..., Window]) -> None:
    model = kind(**SIZES)
    with pytest.raises(ValueError, match="window has 2 pushes; this model was made for 3"):
        model(random_window(steps=2))
    with pytest.raises(ValueError, match=r"one batch \[B\]; got leading dimensions \[1, 4\]"):
        model(random_window().map(lambda tensor: tensor.unsqueeze(0)))


def planned(model: Model, state: State, codes: dict[str, Tensor], action: Tensor) -> dict[str, Tensor]:
    """All that a planner can ask of a model, with the keywords that planners use."""
    answers = {"next_state": model.next_state(state, action).centers}
    if hasattr(model, "subgoal"):
        answers["subgoal"] = model.subgoal(state, codes["effect_code"]).centers
    if hasattr(model, "actions"):
        answers["actions"] = model.actions(state, **codes)
    return answers


def codes_of(model: Model, state: State) -> dict[str, Any]:
    effect = model.effect_prior(state).sample() if hasattr(model, "effect_prior") else None
    motion = model.motion_prior(state, effect_code=effect).sample() if hasattr(model, "motion_prior") else None
    return {"effect_code": effect, "motion_code": motion}


@pytest.mark.parametrize(
    ("kind", "answers"),
    [
        (CascadedModel, {"next_state", "subgoal", "actions"}),
        (SingleLatentModel, {"next_state", "subgoal", "actions"}),
        (FlatModel, {"next_state", "actions"}),
        (DynamicsModel, {"next_state"}),
    ],
)
@settings(max_examples=8)
@given(batch=st.lists(st.integers(1, 3), min_size=1, max_size=3), order=st.permutations(range(4)))
def test_planning_broadcasts_and_ignores_the_order_of_objects(
    random_state: Callable[..., State], kind: type[Model], answers: set[str], batch: list[int], order: list[int]
) -> None:
    model = kind(segment_length=2, **SIZES).double()
    state = random_state(*batch, objects=4, real=3)
    state = State(state.centers.double(), state.features.double(), state.mask)
    codes, action = codes_of(model, state), torch.zeros(*batch, 4, dtype=torch.float64)
    asked = planned(model, state, codes, action)
    assert set(asked) == answers
    shuffled = planned(
        model,
        State(*(state.centers[..., order, :], state.features[..., order, :], state.mask[..., order])),
        codes,
        action,
    )
    shapes = {"next_state": (*batch, 4, 3), "subgoal": (*batch, 4, 3), "actions": (*batch, 2, 4)}
    for name, value in asked.items():
        assert value.shape == shapes[name]
        same = value if name == "actions" else value[..., order, :]
        assert torch.allclose(shuffled[name], same, atol=1e-12)

    # Many plans in one state: [..., 1] with codes and actions [..., 7].
    many = planned(
        model,
        state.map(lambda field: field.unsqueeze(len(batch))),
        {name: None if code is None else code.unsqueeze(-2).expand(*batch, 7, -1) for name, code in codes.items()},
        action.unsqueeze(-2).expand(*batch, 7, 4),
    )
    for name, value in asked.items():
        repeated = value.unsqueeze(len(batch)).expand(*batch, 7, *value.shape[len(batch) :])
        assert torch.allclose(many[name], repeated, atol=1e-12)


@every_model
def test_planning_methods_are_the_means_of_the_program(kind: type[Model], random_window: Callable[..., Window]) -> None:
    window, model = random_window(), kind(**SIZES)
    traced = trace(model, window)
    codes = {
        name: traced.nodes[name]["value"] if name in SITES[kind] else None for name in ("effect_code", "motion_code")
    }
    first, counted = window.first, window.sequence_mask
    if "actions" in SITES[kind]:
        assert torch.allclose(model.actions(first, **codes), traced.nodes["actions"]["fn"].mean, atol=1e-6)
    if "subgoal_centers" in SITES[kind]:
        scored = model.scales.centers(model.subgoal(first, codes["effect_code"]), first.mask)
        scored = scored.log_prob(window.last.centers)
        assert torch.allclose(scored[counted], traced.nodes["subgoal_centers"]["log_prob"][counted], rtol=1e-5)
    last_push = model.next_state(window.states.step(2), window.actions[:, 2])
    scored = model.scales.features(last_push, first.mask).log_prob(window.last.features)
    only_last = window._replace(transition_mask=torch.tensor([False, False, True]).expand(4, 3))
    assert torch.allclose(scored, trace(model, only_last).nodes["next_features"]["log_prob"], rtol=1e-5)


def test_a_code_that_a_model_lacks_is_never_read(random_state: Callable[..., State]) -> None:
    state, z = random_state(2), torch.randn(2, 32)
    flat, single = FlatModel(**SIZES), SingleLatentModel(**SIZES)
    other = torch.full((2, 7), math.nan)
    assert torch.equal(flat.actions(state, effect_code=other, motion_code=z), flat.actions(state, motion_code=z))
    assert torch.equal(single.actions(state, z, motion_code=other), single.actions(state, effect_code=z))
    assert flat.motion_prior(state, other).sample().isfinite().all()


def test_counterparts_of_the_baselines_are_the_networks_of_the_cascade() -> None:
    """Same layers, but for the width of a code and what nothing reads any more."""

    def layers(model: nn.Module) -> dict[str, tuple[int, ...]]:
        return {name: tuple(parameter.shape) for name, parameter in model.named_parameters()}

    cascade = layers(CascadedModel(effect_dimension=32, motion_dimension=32, **SIZES))
    single, flat, dynamics = (layers(kind(**SIZES)) for kind in SITES)
    assert set(cascade) - set(single) == {"action_generator.transform.weight", "action_generator.transform.bias"}
    read_first = {f"action_generator.{part}.0.0.weight" for part in ("starts", "motions")}  # the pool instead of z
    assert {name for name in single if single[name] != cascade[name]} == read_first
    trunk = {f"trunk.{name}.{part}" for name in ("from_state", "second.0") for part in ("weight", "bias")}
    assert set(flat) - set(cascade) == trunk
    assert not {name for name in cascade if name not in flat and not name.startswith("meta_dynamics.")}
    assert all(flat[name] == (cascade[name] if name in cascade else cascade[f"meta_dynamics.{name}"]) for name in flat)
    assert set(dynamics) == {name for name in cascade if name.startswith(("encoder.", "dynamics."))}


def test_the_weight_of_actions_scales_their_term_only(random_window: Callable[..., Window]) -> None:
    window, terms = random_window(), {}
    for weight in (1.0, 0.25):
        torch.manual_seed(0)
        model = SingleLatentModel(action_weight=weight, **SIZES)
        nodes = trace(model, window).nodes
        terms[weight] = {name: nodes[name]["log_prob"] for name in SITES[SingleLatentModel]}
    for name, value in terms[1.0].items():
        assert torch.allclose(terms[0.25][name], value * (0.25 if name == "actions" else 1), rtol=1e-6)


@pytest.mark.parametrize("weight", [0, -1.0, math.inf, math.nan])
def test_a_weight_is_positive(weight: float) -> None:
    with pytest.raises(ValueError, match=f"^action_weight must be a positive number, not {weight}$"):
        SingleLatentModel(action_weight=weight, **SIZES)


class LearnedScales(nn.Module):
    """Scales of which one is a parameter."""

    def __init__(self) -> None:
        super().__init__()
        self.log_center = nn.Parameter(torch.tensor(-4.0))

    def centers(self, mean: State, mask: Tensor, *, event_dims: int = 1) -> TorchDistribution:
        return distributions.Normal(mean.centers, self.log_center.exp()).to_event(event_dims + 1)

    def features(self, mean: State, mask: Tensor, *, event_dims: int = 1) -> TorchDistribution:
        return LikelihoodScales().features(mean, mask, event_dims=event_dims)

    def actions(self, mean: Tensor) -> TorchDistribution:
        return LikelihoodScales().actions(mean)


@pytest.mark.parametrize("kind", [CascadedModel, *SITES])
def test_scales_may_be_a_part_with_parameters(kind: type[Model], random_window: Callable[..., Window]) -> None:
    plain, learned = kind(**SIZES), kind(scales=LearnedScales(), **SIZES)
    assert isinstance(plain.scales, LikelihoodScales)
    assert set(learned.state_dict()) - set(plain.state_dict()) == {"scales.log_center"}
    trace(learned, random_window()).log_prob_sum().backward()
    assert learned.scales.log_center.grad.abs() > 0
