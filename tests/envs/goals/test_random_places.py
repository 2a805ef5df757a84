"""Random places."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs.goals import sample_places
from envs.workspace import TILE_SIDE, tile_center

REGION = [(1, 2), (1, 3), (2, 3), (3, 5)]


@given(st.integers(0, 2**32), st.integers(1, 4))
def test_places_lie_on_the_tiles_and_apart(seed: int, count: int) -> None:
    places = sample_places(REGION, count, 0.1, np.random.default_rng(seed))
    assert len(places) == count
    for place in places:
        offsets = [np.abs(np.array(place) - tile_center(tile)).max() for tile in REGION]
        assert min(offsets) <= TILE_SIDE / 2
    assert all(np.linalg.norm(np.subtract(*pair)) >= 0.1 for pair in combinations(places, 2))
    assert places == sample_places(REGION, count, 0.1, np.random.default_rng(seed))


def test_places_for_which_there_is_no_room_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^no room for 3 places at least 0\.5 m apart in the region: add tiles"):
        sample_places([(1, 2)], 3, 0.5, np.random.default_rng(0))
