from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.networks.dynamics import PUSH_RANGE, SUBGOAL_RANGE, Dynamics, EffectTrunk, MetaDynamics, StateChange
from models.networks.encoder import StateEncoder
from models.state import State

SIZES = {"feature_dimension": 6, "width": 8}


def test_trunk_is_a_linear_layer_on_state_and_repeated_context() -> None:
    trunk = EffectTrunk(4, width=8, encoder_width=8).double()
    encoded = torch.randn(2, 3, 24, dtype=torch.float64)
    context = torch.randn(2, 4, dtype=torch.float64)
    repeated = trunk.context(context).unsqueeze(1).expand(2, 3, 8)
    weight = torch.cat([trunk.from_state.weight, trunk.from_context.weight], 1)
    hidden = (torch.cat([encoded, repeated], -1) @ weight.T + trunk.from_state.bias).relu()
    assert torch.allclose(trunk(encoded, context), trunk.second(hidden), atol=1e-12)


@pytest.mark.parametrize("maximum", [PUSH_RANGE, SUBGOAL_RANGE])
def test_centers_move_no_farther_than_the_range_and_up_to_it(
    random_state: Callable[..., State], maximum: float
) -> None:
    change = StateChange(maximum_displacement=maximum, **SIZES)
    state = random_state(500)
    moved = (change(state, 100 * torch.randn(500, 4, 8)).centers - state.centers).abs()
    assert moved.max() <= maximum + 1e-6
    assert moved.max() > 0.99 * maximum


def test_features_keep_unit_length_and_turn(random_state: Callable[..., State]) -> None:
    change = StateChange(maximum_displacement=0.15, **SIZES)
    state = random_state(20)
    predicted = change(state, 3 * torch.randn(20, 4, 8))
    assert torch.allclose(predicted.features.norm(dim=-1), torch.ones(20, 4), atol=1e-5)
    assert not torch.allclose(predicted.features, state.features, atol=0.1)


def test_a_closed_gate_leaves_the_state_as_it_is(random_state: Callable[..., State]) -> None:
    change = StateChange(maximum_displacement=0.15, **SIZES)
    torch.nn.init.constant_(change.head.bias[:1], -100.0)
    state = random_state(5)
    predicted = change(state, torch.randn(5, 4, 8))
    assert torch.allclose(predicted.centers, state.centers)
    assert torch.allclose(predicted.features, state.features, atol=1e-6)


def test_padding_stays_where_it_is(random_state: Callable[..., State]) -> None:
    change = StateChange(maximum_displacement=0.15, **SIZES)
    state = random_state(5, objects=4, real=2)
    predicted = change(state, torch.randn(5, 4, 8))
    assert torch.equal(predicted.centers[:, 2:], state.centers[:, 2:])
    assert not torch.isclose(predicted.centers[:, :2], state.centers[:, :2]).all(-1).any()
    assert torch.equal(predicted.mask, state.mask)


def test_reordering_objects_reorders_the_prediction(random_state: Callable[..., State]) -> None:
    encoder, dynamics = StateEncoder(**SIZES).double(), Dynamics(**SIZES).double()
    state = random_state(3, objects=4, real=3)
    state = State(state.centers.double(), state.features.double(), state.mask)
    action = torch.randn(3, 4, dtype=torch.float64)
    order = torch.tensor([2, 0, 3, 1])
    shuffled = State(*(field[:, order] for field in state))
    predicted = dynamics(state, encoder(state), action)
    for field, expected in zip(dynamics(shuffled, encoder(shuffled), action), predicted, strict=True):
        assert torch.allclose(field, expected[:, order], atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(batch=st.lists(st.integers(1, 3), min_size=1, max_size=3), objects=st.integers(1, 5))
def test_leading_dimensions_of_states_and_codes_broadcast(
    random_state: Callable[..., State], batch: list[int], objects: int
) -> None:
    encoder = StateEncoder(**SIZES)
    meta_dynamics = MetaDynamics(effect_dimension=5, **SIZES)
    codes = torch.randn(*batch, 5)
    state = random_state(*batch[:-1], 1, objects=objects)
    subgoal = meta_dynamics(state, meta_dynamics.effect(encoder(state), codes))
    assert subgoal.batch_shape == tuple(batch)
    assert subgoal.mask.shape == (*batch, objects)
    alone = state.expand(batch)
    expected = meta_dynamics(alone, meta_dynamics.effect(encoder(alone), codes))
    assert torch.allclose(subgoal.centers, expected.centers, atol=1e-5)
    assert torch.allclose(subgoal.features, expected.features, atol=1e-5)
