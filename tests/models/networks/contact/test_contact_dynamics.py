from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavin_pyro.storage.checkpoint import find_checkpoint, load_checkpoint
from models.networks.contact.dynamics import MAXIMUM_DISPLACEMENT, ContactDynamics
from models.networks.contact.geometry import PUSH_UNIT, REACH_HIGH, REACH_LOW
from models.networks.outline import DIRECTIONS, Outline, standard_features
from models.state import State
from tests.models.networks.contact import by_hand


def scene(*batch: int, objects: int = 3, real: int | None = None) -> State:
    """Boxes somewhere on the table; padding is zero."""
    clouds = (torch.rand(*batch, objects, 64, 3) - 0.5) * torch.tensor([0.08, 0.05, 0.03])
    centers = torch.tensor([0.4, -0.2, 0.0]) + torch.rand(*batch, objects, 3) * torch.tensor([0.3, 0.4, 0.05])
    mask = (torch.arange(objects) < (real or objects)).expand(*batch, objects)
    centers, features = (field * mask.unsqueeze(-1) for field in (centers, Outline()(clouds)))
    return State(centers, features, mask)


def loud(**sizes: int) -> ContactDynamics:
    """Untrained, but every object moves."""
    torch.manual_seed(0)
    f = ContactDynamics(**{"object_width": 16, "pair_width": 8, **sizes}).double()
    torch.nn.init.normal_(f.head.weight, std=0.5)
    torch.nn.init.normal_(f.shape_head.weight, std=0.5)
    return f


def shipped() -> ContactDynamics:
    """f of `checkpoint=contact`, with all objects within reach."""
    part, f = "model.dynamics.", ContactDynamics()
    tensors = load_checkpoint(find_checkpoint("contact")).tensors
    weights = {name[len(part) :]: value for name, value in tensors.items() if name.startswith(part)}
    del weights["still_scale"]
    f.load_state_dict(weights)
    return f.double()


def settled(**options: Any) -> ContactDynamics:
    """Untrained, with motions and changes of shape as small as trained ones."""
    torch.manual_seed(0)
    f = ContactDynamics(object_width=16, pair_width=8, **options).double()
    torch.nn.init.normal_(f.shape_head.weight, std=0.1)
    return f


def doubled(state: State) -> State:
    return State(state.centers.double(), state.features.double(), state.mask)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), real=st.integers(1, 5), padding=st.integers(0, 2), equivariant=st.booleans())
@example(seed=968, real=4, padding=2, equivariant=False)
def test_it_says_what_loops_over_objects_and_directions_say(
    seed: int, real: int, padding: int, equivariant: bool
) -> None:
    f = settled(equivariant=True) if equivariant else shipped()
    torch.manual_seed(seed)
    state = doubled(scene(4, objects=real + padding, real=real))
    for _ in range(2):  # the second push is from where the first leads
        actions = 2.4 * torch.rand(4, 4).double() - 1.2
        with torch.no_grad():
            predicted = f(state, None, actions)
        for number, action in enumerate(actions):
            here = [field[number, :real].numpy() for field in (state.centers, state.features)]
            centers, features = by_hand.next_state(f, *here, action.numpy())
            assert np.allclose(predicted.centers[number, :real], centers, atol=1e-6, rtol=0)
            # Which side the tool meets is a soft choice among constants that are kept in float32.
            assert np.allclose(predicted.features[number, :real], features, atol=2e-6, rtol=0)
        state = predicted


def test_reordering_objects_reorders_the_prediction() -> None:
    f, state, action = loud(), doubled(scene(3, objects=4, real=3)), torch.rand(3, 4).double()
    order = torch.tensor([2, 0, 3, 1])
    predicted, scales = f.outcome(state, None, action)
    shuffled, shuffled_scales = f.outcome(State(*(field[:, order] for field in state)), None, action)
    for field, expected in zip(shuffled, predicted, strict=True):
        assert torch.allclose(field, expected[:, order], atol=1e-10)
    assert torch.allclose(shuffled_scales, scales[:, order], atol=1e-10)
    assert not torch.allclose(predicted.centers, predicted.centers[:, order])


def test_padding_neither_changes_nor_affects_real_objects() -> None:
    f, state, action = loud(), doubled(scene(5, objects=4, real=2)), torch.rand(5, 4).double()
    predicted = f(state, None, action)
    assert torch.equal(predicted.centers[:, 2:], state.centers[:, 2:])
    assert torch.equal(predicted.features[:, 2:], state.features[:, 2:])
    alone = f(State(*(field[:, :2] for field in state)), None, action)
    assert torch.allclose(predicted.centers[:, :2], alone.centers, atol=1e-10)
    assert (alone.centers - state.centers[:, :2]).abs().max() > 1e-4


@pytest.mark.parametrize("equivariant", [True, False])
def test_an_equivariant_f_turns_and_shifts_with_the_table_and_no_other_does(equivariant: bool) -> None:
    # Extents are sampled in so many directions: only turns by multiples of their angle turn the series exactly.
    f, angle, shift = loud(equivariant=equivariant), 10 * math.pi / DIRECTIONS, torch.tensor([-0.03, 0.05]).double()
    clouds = (torch.rand(4, 3, 64, 3).double() - 0.5) * torch.tensor([0.08, 0.05, 0.03]).double()
    places = 0.08 * torch.rand(4, 3, 3).double()
    starts, motions = 0.05 * torch.rand(4, 2).double(), 0.08 * (torch.rand(4, 2).double() - 0.5)
    turn = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]).double()
    full = torch.block_diag(turn, torch.ones(1, 1).double())
    origin = torch.tensor([0.5, 0.0]).double()

    def outcome(turn: Tensor, full: Tensor, shift: Tensor) -> State:
        low, high = torch.tensor((REACH_LOW, REACH_HIGH)).double()
        centers = places @ full + torch.cat((origin + shift, shift.new_zeros(1)))
        start = (2 * (starts @ turn + origin + shift - low) / (high - low)) - 1
        outline = Outline().double()
        action = torch.cat((start, motions @ turn / PUSH_UNIT), -1)
        predicted = f(State(centers, outline(clouds @ full), torch.ones(4, 3, dtype=torch.bool)), None, action)
        return predicted._replace(centers=predicted.centers - centers)

    eye = torch.eye(3).double()
    here, there = outcome(eye[:2, :2], eye, 0 * shift), outcome(turn, full, shift)
    assert torch.allclose(here.centers @ full, there.centers, atol=1e-6) == equivariant
    assert here.centers.abs().max() > 0.01


def test_other_objects_matter() -> None:
    f, state, action = loud(), doubled(scene(5, objects=3)), torch.rand(5, 4).double()
    alone = f(State(*(field[:, :1] for field in state)), None, action)
    assert not torch.allclose(f(state, None, action).centers[:, :1], alone.centers, atol=1e-6)


@settings(max_examples=15, deadline=None)
@given(batch=st.lists(st.integers(1, 3), min_size=1, max_size=3), objects=st.integers(1, 5))
def test_leading_dimensions_of_states_and_pushes_broadcast(batch: list[int], objects: int) -> None:
    f, state, actions = loud(), doubled(scene(*batch[:-1], 1, objects=objects)), torch.rand(*batch, 4).double()
    predicted, scales = f.outcome(state, None, actions)
    assert predicted.batch_shape == tuple(batch)
    assert predicted.mask.shape == (*batch, objects)
    assert scales.shape == (*batch, objects, 2)
    expected = f(state.expand(batch), None, actions)
    assert torch.allclose(predicted.centers, expected.centers, atol=1e-10)
    assert torch.allclose(predicted.features, expected.features, atol=1e-10)


def test_predictions_are_states_within_range() -> None:
    f, state = loud(), doubled(scene(200))
    torch.nn.init.normal_(f.head.weight, std=50.0)
    predicted, scales = f.outcome(state, None, 2 * torch.rand(200, 4).double() - 1)
    assert (predicted.centers - state.centers).norm(dim=-1).max() <= 3**0.5 * MAXIMUM_DISPLACEMENT
    assert torch.allclose(predicted.features.norm(dim=-1), torch.ones(200, 3).double())
    assert scales.min() > 0
    assert scales.isfinite().all()


def test_a_push_of_no_length_gives_numbers() -> None:
    state = doubled(scene(1))
    push = torch.zeros(1, 4, dtype=torch.float64, requires_grad=True)
    predicted = loud()(state, None, push)
    predicted.centers.sum().backward()
    assert predicted.centers.isfinite().all()
    assert push.grad is not None
    assert push.grad.isfinite().all()


def test_features_that_are_no_outlines_are_refused(random_state: Callable[..., State]) -> None:
    with pytest.raises(ValueError, match="dynamics=contact reads outlines with 64 numbers, not 32"):
        ContactDynamics(feature_dimension=32)
    assert standard_features(torch.zeros(63))[-1] == 1


def test_only_the_nearest_others_matter_if_there_are_more_than_neighbours() -> None:
    f, state, action = loud(), doubled(scene(1, objects=3)), torch.rand(1, 4).double()
    f.neighbours = 1
    state.centers[0, :, 0] = torch.tensor([0.4, 0.45, 0.6])
    state.centers[0, :, 1] = 0.0
    near = f(state, None, action).centers[:, :2]
    state.centers[0, 2, 1] += 0.05
    assert torch.allclose(f(state, None, action).centers[:, :2], near, atol=1e-12)
    order = torch.tensor([2, 0, 1])
    shuffled = f(State(*(field[:, order] for field in state)), None, action).centers
    assert torch.allclose(shuffled, f(state, None, action).centers[:, order], atol=1e-10)
    f.neighbours = None
    assert not torch.allclose(f(state, None, action).centers[:, :2], near, atol=1e-6)


def test_with_as_many_neighbours_as_others_nothing_changes() -> None:
    f, state, action = loud(), doubled(scene(3, objects=5, real=4)), torch.rand(3, 4).double()
    every = f(state, None, action).centers
    f.neighbours = 4
    assert torch.equal(f(state, None, action).centers, every)
