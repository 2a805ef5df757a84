from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from models.networks.encoder import StateEncoder
from models.state import State


def small_encoder(neighbours: int | None = None) -> StateEncoder:
    return StateEncoder(feature_dimension=6, width=8, neighbours=neighbours).double()


def double(state: State) -> State:
    return State(state.centers.double(), state.features.double(), state.mask)


def relations_pair_by_pair(encoder: StateEncoder, positions: Tensor, mask: Tensor, most: int = 9) -> Tensor:
    """The definition: for one scene, two FC on each difference, summed over the nearest other real objects."""
    rows = []
    for i in range(len(positions)):
        total = torch.zeros(8, dtype=positions.dtype)
        others = [j for j in range(len(positions)) if j != i and mask[j]]
        for j in sorted(others, key=lambda j: (positions[j] - positions[i])[:2].norm())[:most]:
            total = total + encoder.relation(encoder.difference(positions[j] - positions[i]).relu())
        rows.append(total)
    return torch.stack(rows)


def test_relations_equal_their_definition_pair_by_pair(random_state: Callable[..., State]) -> None:
    encoder = small_encoder()
    state = double(random_state(objects=5, real=4))
    positions = (state.centers - torch.tensor([0.6, 0.0, 0.0], dtype=torch.float64)) / 0.1
    expected = relations_pair_by_pair(encoder, positions, state.mask)
    assert torch.allclose(encoder(state)[:, 16:], expected, atol=1e-12)
    assert expected.abs().max() > 0.1


def test_relations_of_many_objects_are_those_to_the_nearest(random_state: Callable[..., State]) -> None:
    encoder = small_encoder(neighbours=4)
    state = double(random_state(objects=9, real=8))
    positions = (state.centers - torch.tensor([0.6, 0.0, 0.0], dtype=torch.float64)) / 0.1
    relations = encoder(state)[:8, 16:]
    assert torch.allclose(relations, relations_pair_by_pair(encoder, positions, state.mask, 4)[:8], atol=1e-12)
    encoder.neighbours = None
    assert not torch.allclose(encoder(state)[:8, 16:], relations, atol=0.1)


@given(objects=st.integers(1, 5), real=st.integers(1, 5))
@settings(max_examples=15, deadline=None)
def test_with_few_objects_the_nearest_are_all(random_state: Callable[..., State], objects: int, real: int) -> None:
    encoder = small_encoder()
    state = double(random_state(3, objects=objects, real=min(real, objects)))
    every = encoder(state)
    encoder.neighbours = 4
    assert torch.equal(encoder(state), every)


@pytest.mark.parametrize("most", [None, 2])
def test_reordering_objects_reorders_features(random_state: Callable[..., State], most: int | None) -> None:
    encoder = small_encoder(most)
    state = double(random_state(3, objects=5, real=4))
    order = torch.tensor([4, 2, 0, 3, 1])
    shuffled = State(state.centers[:, order], state.features[:, order], state.mask[:, order])
    assert torch.allclose(encoder(shuffled), encoder(state)[:, order], atol=1e-12)


@pytest.mark.parametrize("most", [None, 1])
def test_padding_does_not_touch_real_objects(random_state: Callable[..., State], most: int | None) -> None:
    encoder = small_encoder(most)
    state = double(random_state(3, objects=3))
    padding = double(random_state(3, objects=2, real=0))
    padded = State(*(torch.cat(pair, 1) for pair in zip(state, padding, strict=True)))
    assert torch.allclose(encoder(padded)[:, :3], encoder(state), atol=1e-12)
    real = padded._replace(mask=torch.ones_like(padded.mask))
    assert not torch.allclose(encoder(real)[:, :3], encoder(state), atol=1e-3)


def test_an_object_alone_has_no_relations(random_state: Callable[..., State]) -> None:
    encoded = small_encoder()(double(random_state(2, objects=1)))
    assert encoded.shape == (2, 1, 24)
    assert torch.equal(encoded[..., 16:], torch.zeros(2, 1, 8, dtype=torch.float64))


@settings(max_examples=15, deadline=None)
@given(batch=st.lists(st.integers(1, 3), max_size=3), objects=st.integers(1, 10))
def test_any_leading_dimensions_give_what_each_scene_gives_alone(
    random_state: Callable[..., State], batch: list[int], objects: int
) -> None:
    encoder = small_encoder(neighbours=4)
    state = double(random_state(*batch, objects=objects))
    encoded = encoder(state)
    assert encoded.shape == (*batch, objects, 24)
    last = tuple(size - 1 for size in batch)
    assert torch.allclose(encoded[last], encoder(State(*(field[last] for field in state))), atol=1e-12)


def test_features_of_another_length_are_refused(random_state: Callable[..., State]) -> None:
    with pytest.raises(ValueError, match="features have 7 numbers per object; this model expects 6"):
        small_encoder()(random_state(features=7))
