"""The networks of the paper: encoder, f, h, g and PointNet."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavin_pyro.envs.tabletop.robots.robot import STICK_RADIUS
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.envs.tabletop.workspace import TABLE_CENTER as CENTER
from cavin_pyro.models.networks.contact.geometry import PUSH_UNIT, TABLE_CENTER, TOOL_RADIUS
from cavin_pyro.models.networks.dynamics import ActionGenerator, Dynamics, Outcome, StateChange
from cavin_pyro.models.networks.layers import StateEncoder, neighbours
from cavin_pyro.models.networks.pointnet import PointNet, PointNetAutoencoder, chamfer_distance
from cavin_pyro.models.networks.residual import ResidualDynamics
from cavin_pyro.models.state import State

SIZES = {"feature_dimension": 6, "width": 8}
ORDER = torch.tensor([2, 0, 3, 1])


def small_encoder(most: int | None = None) -> StateEncoder:
    return StateEncoder(SPACE, **SIZES, neighbours=most).double()


def double(state: State) -> State:
    return State(state.centers.double(), state.features.double(), state.mask)


def test_networks_know_the_table_and_the_tool_as_the_environments_do() -> None:
    """They do not know the environments, and so have these numbers a second time."""
    assert (*CENTER, 0.0) == TABLE_CENTER and SPACE.length == PUSH_UNIT
    assert TOOL_RADIUS == STICK_RADIUS


@settings(max_examples=20, deadline=None)
@given(objects=st.integers(1, 10), padding=st.integers(0, 3), most=st.none() | st.integers(1, 10))
def test_neighbours_are_the_nearest_others_that_are_real(
    random_state: Callable[..., State], objects: int, padding: int, most: int | None
) -> None:
    state = random_state(3, objects=objects + padding, real=objects)
    number = torch.arange(objects + padding).float().unsqueeze(-1).expand(3, -1, 1)
    found = [(other.of(number)[..., 0], other.real) for other in neighbours(state.centers, state.mask, most)]
    planar = state.centers[..., :2]
    for scene in range(3):
        for i in range(objects):
            others = sorted(set(range(objects)) - {i}, key=lambda j: (planar[scene, i] - planar[scene, j]).norm())
            mine = [int(who[scene, i]) for who, real in found if real[scene, i]]
            assert sorted(mine) == sorted(others[:most])


@pytest.mark.parametrize("kind", [Dynamics, ResidualDynamics])
@pytest.mark.parametrize("most", [None, 2])
def test_order_and_padding_leave_features_and_predictions(
    random_state: Callable[..., State], most: int | None, kind: type[Outcome]
) -> None:
    encoder, dynamics = small_encoder(most), kind(SPACE, **SIZES).double()
    dynamics.neighbours = most
    state, action = double(random_state(3, objects=4, real=3)), torch.randn(3, 4, dtype=torch.float64)
    shuffled = state.map(lambda field: field[:, ORDER])
    assert torch.allclose(encoder(shuffled), encoder(state)[:, ORDER], atol=1e-12)
    short = state.map(lambda field: field[:, :3])
    assert torch.allclose(encoder(state)[:, :3], encoder(short), atol=1e-12)
    real = state._replace(mask=torch.ones_like(state.mask))
    assert not torch.allclose(encoder(real)[:, :3], encoder(state)[:, :3], atol=1e-3)
    predicted = dynamics(state, encoder(state), action)
    for field, expected in zip(dynamics(shuffled, encoder(shuffled), action), predicted, strict=True):
        assert torch.allclose(field, expected[:, ORDER], atol=1e-12)
    assert torch.equal(predicted.centers[:, 3], state.centers[:, 3])
    for field, expected in zip(dynamics(short, encoder(short), action), predicted, strict=True):
        assert torch.allclose(field, expected[:, :3], atol=1e-12)


def test_an_object_alone_has_no_relations(random_state: Callable[..., State]) -> None:
    assert not small_encoder()(double(random_state(2, objects=1)))[..., 16:].any()


@pytest.mark.parametrize("maximum", [SPACE.step_range, SPACE.subgoal_range])
def test_states_change_within_their_range_and_not_behind_a_closed_gate(
    random_state: Callable[..., State], maximum: float
) -> None:
    change, state = StateChange(SPACE, maximum_displacement=maximum, **SIZES), random_state(500, objects=4, real=2)
    predicted = change(state, 100 * torch.randn(500, 4, 8))
    moved = (predicted.centers - state.centers).abs()
    assert 0.99 * maximum < moved.max() <= maximum + 1e-6
    assert not moved[:, 2:].any()  # padding
    assert torch.allclose(predicted.features.norm(dim=-1), torch.ones(500, 4), atol=1e-5)
    torch.nn.init.constant_(change.head.bias[:1], -100.0)
    assert torch.allclose(change(state, torch.randn(500, 4, 8)).centers, state.centers)


def test_actions_do_not_depend_on_order_and_padding_and_are_clipped_softly(random_state: Callable[..., State]) -> None:
    generator, scene = ActionGenerator(SPACE, motion_dimension=5, width=8).double(), random_state(objects=4, real=3)
    effect, code = torch.randn(3, 4, 8, dtype=torch.float64), torch.randn(3, 5, dtype=torch.float64)
    actions = generator(effect, scene, code)
    assert torch.allclose(generator(effect[:, ORDER], scene.scene(ORDER), code), actions, atol=1e-12)
    assert torch.allclose(generator(effect[:, :3], scene.scene(slice(3)), code), actions, atol=1e-12)
    assert not torch.allclose(generator(effect, random_state(objects=4), code), actions, atol=1e-4)
    assert generator(effect, random_state(objects=4, real=0), code).isfinite().all()  # no objects
    wide = generator(effect[:1], scene, 1e4 * torch.randn(200, 5, dtype=torch.float64))
    assert 4.9 < wide[..., :2].abs().max() <= 5
    assert 0.99 < wide[..., 2:].abs().max() <= 1


@settings(max_examples=10, deadline=None)
@given(batch=st.lists(st.integers(1, 3), max_size=3), points=st.integers(1, 9))
def test_pointnet_gives_unit_vectors_whatever_the_order_of_points(batch: list[int], points: int) -> None:
    network, clouds = PointNet(), 0.05 * torch.randn(*batch, points, 3)
    features = network(clouds)
    assert features.shape == (*batch, 64)
    assert torch.allclose(features.norm(dim=-1), torch.ones(batch), atol=1e-5)
    assert torch.allclose(network(clouds[..., torch.randperm(points), :]), features, atol=1e-6)
    assert PointNetAutoencoder(points=7)(clouds).shape == (*batch, 7, 3)


def chamfer_by_loops(a: Tensor, b: Tensor) -> float:
    def one_way(source: Tensor, target: Tensor) -> float:
        return sum(min(float(((p - q) ** 2).sum()) for q in target) for p in source) / len(source)

    return one_way(a, b) + one_way(b, a)


def test_chamfer_distance_equals_loops_over_points_and_is_zero_with_a_finite_gradient_at_zero() -> None:
    a, b = torch.randn(2, 30, 3, dtype=torch.float64), torch.randn(2, 40, 3, dtype=torch.float64)
    expected = torch.tensor([chamfer_by_loops(*pair) for pair in zip(a, b, strict=True)], dtype=torch.float64)
    assert torch.allclose(chamfer_distance(a, b), expected, atol=1e-12)
    same = a.clone().requires_grad_()
    distance = chamfer_distance(same, a[:, torch.randperm(30)])
    distance.sum().backward()
    assert not distance.any() and same.grad is not None and same.grad.isfinite().all()
