"""What objects are sampled, and where they are put."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.objects.sampling import WHOLE_TABLE, Area, ObjectRanges, arrange, sample_objects
from envs.objects.shapes import BUILTIN_NAMES, builtin_shape
from envs.workspace import TABLE_HIGH, TABLE_LOW

SEEDS = st.integers(0, 2**32 - 1)
TWO_TILES: Area = (((0.3, -0.2), (0.45, -0.05)), ((0.7, 0.2), (0.85, 0.35)))


def within(area: Area, point: np.ndarray) -> bool:
    return any((np.array(low) <= point).all() and (point <= np.array(high)).all() for low, high in area)


@settings(deadline=None)
@given(seed=SEEDS, count=st.integers(1, 5), clearance=st.floats(0.0, 0.18))
def test_arranged_objects_keep_their_distance_and_their_areas(seed: int, count: int, clearance: float) -> None:
    areas = [TWO_TILES, *[WHOLE_TABLE] * (count - 1)]
    positions = arrange(areas, clearance, np.random.default_rng(seed))
    assert positions.shape == (count, 2)
    assert all(within(area, point) for area, point in zip(areas, positions, strict=True))
    assert all(np.linalg.norm(one - other) >= clearance for one, other in combinations(positions, 2))


def test_every_rectangle_of_an_area_is_used() -> None:
    generator = np.random.default_rng(0)
    sampled = np.concatenate([arrange([TWO_TILES], 0.1, generator) for _ in range(200)])
    for rectangle in TWO_TILES:
        assert 60 < sum(within((rectangle,), point) for point in sampled) < 140


def test_too_small_an_area_gets_its_one_line() -> None:
    tile: Area = (((0.3, 0.0), (0.4, 0.1)),)
    arrange([tile], 0.15, np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"^no room for 2 objects at least 0.15 m apart .* fewer objects") as caught:
        arrange([tile, tile], 0.15, np.random.default_rng(0))
    assert "\n" not in str(caught.value)


RANGES = ObjectRanges(names=("banana", "mug", "sugar_box"), scale=(0.9, 1.1), mass=(2.0, 3.0), friction=(0.6, 0.7))


@settings(deadline=None)
@given(seed=SEEDS, count=st.integers(1, 5))
def test_parameters_lie_within_their_ranges(seed: int, count: int) -> None:
    sampled = sample_objects([WHOLE_TABLE] * count, RANGES, np.random.default_rng(seed))
    assert len(sampled) == count
    for one in sampled:
        shape = builtin_shape(one.name)
        assert one.name in RANGES.names
        assert 0.9 <= one.scale <= 1.1
        assert 2.0 * shape.mass <= one.mass <= 3.0 * shape.mass
        assert 0.6 <= one.friction <= 0.7
        assert np.linalg.norm(one.orientation) == pytest.approx(1.0)
        assert (np.array(TABLE_LOW) < one.position[:2]).all() and (np.array(TABLE_HIGH) > one.position[:2]).all()


@settings(deadline=None)
@given(seed=SEEDS)
def test_no_object_starts_in_the_table_or_in_another_whatever_their_turn(seed: int) -> None:
    sampled = sample_objects([WHOLE_TABLE] * 5, ObjectRanges(clearance=0.1), np.random.default_rng(seed))
    spheres = [(np.array(one.position), one.scale * builtin_shape(one.name).radius) for one in sampled]
    assert all(center[2] > radius for center, radius in spheres)
    for (center, radius), (other, reach) in combinations(spheres, 2):
        apart = np.linalg.norm(center[:2] - other[:2]) >= radius + reach
        assert apart or abs(center[2] - other[2]) >= radius + reach


def test_every_shape_and_a_wide_range_of_sizes_turn_up() -> None:
    generator = np.random.default_rng(0)
    sampled = [one for _ in range(60) for one in sample_objects([WHOLE_TABLE] * 3, ObjectRanges(), generator)]
    assert {one.name for one in sampled} == set(BUILTIN_NAMES)
    assert min(one.scale for one in sampled) < 0.85 and max(one.scale for one in sampled) > 1.15


@settings(deadline=None, max_examples=20)
@given(SEEDS)
def test_the_same_seed_samples_the_same_objects(seed: int) -> None:
    first, again = (sample_objects([WHOLE_TABLE] * 4, RANGES, np.random.default_rng(seed)) for _ in range(2))
    other = sample_objects([WHOLE_TABLE] * 4, RANGES, np.random.default_rng(seed + 1))
    assert first == again != other
