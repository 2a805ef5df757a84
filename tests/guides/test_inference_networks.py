from __future__ import annotations

from collections.abc import Callable

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from guides.networks import EffectInference, MotionInference
from models.networks.layers import SCALE_FLOOR, GaussianCode
from models.state import State, Window


def double(state: State) -> State:
    return State(state.centers.double(), state.features.double(), state.mask)


def reorder(state: State, order: torch.Tensor) -> State:
    return State(*(field[:, order] for field in state))


def test_order_and_padding_of_objects_do_not_matter_to_the_effect(
    random_window: Callable[..., Window],
) -> None:
    network = EffectInference(feature_dimension=6, width=8).double()
    window = random_window()
    s, goal = double(window.first), double(window.last)
    code = network(s, goal)
    order = torch.tensor([3, 1, 0, 2])
    for same in (network(reorder(s, order), reorder(goal, order)), network(*without_padding(s, goal))):
        assert torch.allclose(same.base_dist.loc, code.base_dist.loc, atol=1e-12)
        assert torch.allclose(same.base_dist.scale, code.base_dist.scale, atol=1e-12)


def without_padding(s: State, goal: State) -> tuple[State, State]:
    kept = torch.arange(3)
    return reorder(s, kept), reorder(goal, kept)


def test_effect_depends_on_centers_and_on_features(random_window: Callable[..., Window]) -> None:
    network = EffectInference(feature_dimension=6, width=8)
    s, goal = random_window().first, random_window().last
    code = network(s, goal).mean
    assert not torch.allclose(network(s, goal._replace(centers=goal.centers + 0.1)).mean, code, atol=1e-3)
    assert not torch.allclose(network(s, goal._replace(features=-goal.features)).mean, code, atol=1e-3)


def test_order_and_padding_of_objects_do_not_matter_to_the_motion() -> None:
    network = MotionInference(width=8, encoder_width=8).double()
    encoded, mask = torch.randn(3, 4, 24, dtype=torch.float64), torch.tensor([True, True, True, False])
    actions, c = torch.randn(3, 3, 4, dtype=torch.float64), torch.randn(3, 16, dtype=torch.float64)
    code = network(encoded, mask.expand(3, 4), actions, c)
    order = torch.tensor([3, 1, 0, 2])
    shuffled = network(encoded[:, order], mask[order].expand(3, 4), actions, c)
    shorter = network(encoded[:, :3], mask[:3].expand(3, 3), actions, c)
    for same in (shuffled, shorter):
        assert torch.allclose(same.base_dist.loc, code.base_dist.loc, atol=1e-12)


def test_motion_depends_on_state_code_and_the_order_of_pushes() -> None:
    network = MotionInference(width=8, encoder_width=8)
    encoded, mask = torch.randn(3, 4, 24), torch.ones(3, 4, dtype=torch.bool)
    actions, c = torch.randn(3, 3, 4), torch.randn(3, 16)
    code = network(encoded, mask, actions, c).mean
    for other in ((encoded + 1, actions, c), (encoded, actions.flip(1), c), (encoded, actions, c + 1)):
        assert not torch.allclose(network(other[0], mask, *other[1:]).mean, code, atol=1e-4)


def test_scales_stay_above_the_floor() -> None:
    head = GaussianCode(3, width=8)
    torch.nn.init.constant_(head.head.bias, -1e4)
    assert torch.allclose(head(torch.randn(5, 8)).base_dist.scale, torch.tensor(SCALE_FLOOR))


@settings(max_examples=10, deadline=None)
@given(batch=st.lists(st.integers(1, 3), max_size=2), particles=st.integers(1, 3))
def test_extra_dimensions_of_the_code_broadcast(batch: list[int], particles: int) -> None:
    network = MotionInference(width=8, encoder_width=8)
    encoded, mask = torch.randn(*batch, 4, 24), torch.ones(*batch, 4, dtype=torch.bool)
    actions, c = torch.randn(*batch, 3, 4), torch.randn(particles, *batch, 16)
    code = network(encoded, mask, actions, c)
    assert (code.batch_shape, code.event_shape) == ((particles, *batch), (16,))
    assert torch.allclose(code.mean[0], network(encoded, mask, actions, c[0]).mean, atol=1e-5)
