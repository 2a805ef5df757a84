from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from models.networks.encoder import neighbours, squared_distances
from models.state import State


def numbers(centers: Tensor, mask: Tensor, most: int | None) -> list[list[set[int]]]:
    """Which real objects are neighbours of each object of each scene [B, M]."""
    own = torch.arange(mask.shape[-1]).float().expand(mask.shape)
    found = [(other.of(own.unsqueeze(-1)).squeeze(-1).int(), other.real) for other in neighbours(centers, mask, most)]
    return [
        [{int(who[scene, i]) for who, real in found if real[scene, i]} for i in range(mask.shape[1])]
        for scene in range(len(mask))
    ]


@settings(max_examples=20, deadline=None)
@given(objects=st.integers(1, 10), padding=st.integers(0, 3), most=st.none() | st.integers(0, 10))
def test_neighbours_are_the_nearest_others_that_are_real(
    random_state: Callable[..., State], objects: int, padding: int, most: int | None
) -> None:
    state = random_state(3, objects=objects + padding, real=objects)
    found = numbers(state.centers, state.mask, most)
    planar = state.centers[..., :2]
    for scene in range(3):
        for i in range(objects):
            others = sorted(set(range(objects)) - {i}, key=lambda j: (planar[scene, i] - planar[scene, j]).norm())
            assert found[scene][i] == set(others[:most])


@pytest.mark.parametrize("most", [None, 4, 2])
def test_each_neighbour_is_visited_once(random_state: Callable[..., State], most: int | None) -> None:
    state = random_state(2, objects=5)
    visited = sum(other.real.sum(-1) for other in neighbours(state.centers, state.mask, most))
    assert visited.tolist() == [5 * (most or 4)] * 2
    assert [len(each) for scene in numbers(state.centers, state.mask, most) for each in scene] == [most or 4] * 10


def test_rows_are_those_of_the_neighbour_for_any_leading_dimensions(random_state: Callable[..., State]) -> None:
    state = random_state(2, 1, objects=8)
    values = torch.randn(3, 2, 4, 8, 5)  # more scenes than states: each with several pushes
    (nearest,) = neighbours(state.centers, state.mask, 1)
    index = squared_distances(state.centers, state.mask).argmin(-1).expand(3, 2, 4, 8)
    assert torch.equal(nearest.of(values), values.take_along_dim(index.unsqueeze(-1), -2))


def test_an_object_is_infinitely_far_from_itself_and_from_padding(random_state: Callable[..., State]) -> None:
    state = random_state(objects=3, real=2)
    finite = squared_distances(state.centers, state.mask).isfinite()
    assert finite.tolist() == [[False, True, False], [True, False, False], [True, True, False]]


def test_gradients_flow_through_neighbours(random_state: Callable[..., State]) -> None:
    state, values = random_state(objects=6), torch.randn(6, 2, requires_grad=True)
    (nearest,) = neighbours(state.centers, state.mask, 1)
    nearest.of(values).sum().backward()
    index = squared_distances(state.centers, state.mask).argmin(-1)
    assert values.grad is not None
    assert torch.equal(values.grad[:, 0], torch.bincount(index, minlength=6).float())
