"""Which place is whose."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.goals import Goal, assign
from envs.goals.assignment import SHAPE_WEIGHT, outlines
from envs.observation import Observation
from envs.workspace import OBJECT_SLOTS, POINTS_PER_OBJECT

# Half length, half width and height in metres of a book, a can and a cube.
BOOK, CAN, CUBE = (0.09, 0.06, 0.03), (0.035, 0.035, 0.12), (0.03, 0.03, 0.06)
SHAPES = (BOOK, CAN, CUBE)

angles = st.floats(-np.pi, np.pi)
points = st.tuples(st.floats(0.3, 0.9), st.floats(-0.5, 0.5))


def cloud(
    shape: tuple[float, float, float], place: tuple[float, float], angle: float = 0.0, seed: int = 0
) -> np.ndarray:
    """Points on the top of a block that is turned by an angle, with a millimetre of noise: [256, 3] metres."""
    generator = np.random.default_rng(seed)
    flat = generator.uniform(-1.0, 1.0, (POINTS_PER_OBJECT, 2)) * shape[:2]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    top = np.full((POINTS_PER_OBJECT, 1), shape[2])
    noise = 0.001 * generator.standard_normal((POINTS_PER_OBJECT, 3))
    return (np.concatenate([flat @ turn.T + place, top], axis=-1) + noise).astype(np.float32)


def goal(*clouds: np.ndarray) -> Goal:
    return Goal(np.array([one.mean(axis=0) for one in clouds]), np.array(clouds))


def observed(*clouds: np.ndarray) -> Observation:
    padded = np.zeros((OBJECT_SLOTS, POINTS_PER_OBJECT, 3), np.float32)
    padded[: len(clouds)] = clouds
    mask = np.arange(OBJECT_SLOTS) < len(clouds)
    return Observation(padded, padded.mean(axis=1), mask, mask)


@given(st.permutations(range(3)), st.lists(points, min_size=6, max_size=6), st.lists(angles, min_size=6, max_size=6))
def test_objects_that_differ_go_where_the_goal_shows_them_however_far_and_turned(
    order: list[int], places: list[tuple[float, float]], turns: list[float]
) -> None:
    shown = [cloud(SHAPES[kind], places[number], turns[number], seed=number) for number, kind in enumerate(order)]
    starts = [cloud(shape, places[3 + kind], turns[3 + kind], seed=9 + kind) for kind, shape in enumerate(SHAPES)]
    found = assign(observed(*starts), goal(*shown))
    for kind, place in enumerate(found):
        np.testing.assert_allclose(place, shown[order.index(kind)].mean(axis=0)[:2], atol=1e-6)


@given(st.lists(points, min_size=3, max_size=3), st.lists(points, min_size=3, max_size=3))
def test_objects_that_look_the_same_take_the_shortest_ways_in_total(
    starts: list[tuple[float, float]], places: list[tuple[float, float]]
) -> None:
    block = cloud(CUBE, (0.0, 0.0))
    block -= block.mean(axis=0)
    clouds, shown = ([block + np.float32([*point, 0.0]) for point in some] for some in (starts, places))
    found = assign(observed(*clouds), goal(*shown))
    ways = [np.linalg.norm(np.array(order) - np.array(starts), axis=-1).sum() for order in permutations(places)]
    # The clouds are the same but for rounding, which counts `SHAPE_WEIGHT` times.
    assert np.linalg.norm(np.array(found) - np.array(starts), axis=-1).sum() <= min(ways) + SHAPE_WEIGHT * 1e-5


@given(st.sampled_from(SHAPES), points, angles)
def test_an_outline_stays_the_same_as_an_object_moves_and_turns(
    shape: tuple[float, float, float], place: tuple[float, float], angle: float
) -> None:
    here, there = cloud(shape, (0.6, 0.0)), cloud(shape, place, angle)
    np.testing.assert_allclose(outlines(here[None]), outlines(there[None]), atol=5e-4)


def test_an_outline_is_of_height_length_and_width() -> None:
    (found,) = outlines(cloud(BOOK, (0.5, 0.2), 0.7)[None])
    expected = [BOOK[2], BOOK[0] / np.sqrt(3), BOOK[1] / np.sqrt(3)]  # a uniform block's standard deviations
    assert found == pytest.approx(expected, abs=5e-3)
