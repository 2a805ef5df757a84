"""Rearranging: places given or at random, and rewards."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cavin_pyro.envs.tabletop.layouts import parse_task
from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.envs.tabletop.tasks import Outcome, TaskReward
from cavin_pyro.envs.tabletop.tasks.rearrange import LEAST_TOLERANCE, TOLERANCE, Rearrange, sample_places
from cavin_pyro.envs.tabletop.workspace import TILE_SIDE, tile_center

angles = st.floats(-np.pi, np.pi)

REGION = [(1, 2), (1, 3), (2, 3), (3, 5)]


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32), st.integers(1, 4))
def test_places_lie_on_the_tiles_and_apart(seed: int, count: int) -> None:
    places = sample_places(REGION, count, 0.1, np.random.default_rng(seed))
    assert len(places) == count
    for place in places:
        offsets = [np.abs(np.array(place) - tile_center(tile)).max() for tile in REGION]
        assert min(offsets) <= TILE_SIDE / 2
    assert all(np.linalg.norm(np.subtract(*pair)) >= 0.1 for pair in combinations(places, 2))
    assert places == sample_places(REGION, count, 0.1, np.random.default_rng(seed))


LAYOUT = {"region": [(1, 3)], "target_start": [(1, 1)], "obstacle_start": [(1, 5)]}
PLACES = ((0.5, 0.1), (0.4, -0.2))
TASK = Rearrange(places=PLACES, **LAYOUT)
MASK = torch.tensor([True, True])

offsets = st.floats(0.0, 0.08)


def states(*points: tuple[float, float]) -> torch.Tensor:
    return torch.tensor([[*point, 0.03] for point in points], dtype=torch.float64)


def away(place: tuple[float, float], distance: float, angle: float) -> tuple[float, float]:
    return place[0] + distance * np.cos(angle), place[1] + distance * np.sin(angle)


def rearrange(*points: tuple[float, float], task: Rearrange = TASK, **options: Any) -> Outcome:
    after = states(*points)
    return TaskReward(task, **options)(states(*[(0.6, 0.3)] * len(points)), after, torch.ones(len(points)) > 0)


@settings(deadline=None, max_examples=30)
@given(offsets, offsets, angles, angles)
def test_it_succeeds_when_every_object_is_within_the_tolerance(one: float, other: float, a: float, b: float) -> None:
    points = away(PLACES[0], one, a), away(PLACES[1], other, b)
    if min(abs(one - TOLERANCE), abs(other - TOLERANCE)) > 1e-9:
        assert bool(rearrange(*points).success) == (one < TOLERANCE and other < TOLERANCE)
    assert bool(rearrange(*points, margin=0.0).success) >= bool(rearrange(*points, margin=0.01).success)


def test_a_margin_asks_planners_for_more_but_never_for_the_impossible() -> None:
    assert rearrange(away(PLACES[0], 0.019, 1.0), PLACES[1], margin=0.01).success
    assert not rearrange(away(PLACES[0], 0.021, 1.0), PLACES[1], margin=0.01).success
    for margin in (0.02, 0.05):
        assert rearrange(away(PLACES[0], 0.9 * LEAST_TOLERANCE, 1.0), PLACES[1], margin=margin).success
        assert not rearrange(away(PLACES[0], 1.1 * LEAST_TOLERANCE, 1.0), PLACES[1], margin=margin).success


def test_dense_progress_is_the_way_that_objects_came_closer_to_their_places() -> None:
    before, after = states((0.5, 0.3), (0.4, -0.5)), states((0.5, 0.2), (0.4, -0.55))
    outcome = TaskReward(TASK, reward="dense")(before, after, MASK)
    assert outcome.terms["progress"].item() == pytest.approx(0.1 - 0.05, abs=1e-6)


def test_every_seed_has_places_of_its_own_and_always_the_same() -> None:
    env = PushingEnv(task="rearrange", reward="dense")
    found = [env.reset(seed=seed)[1]["task"] for seed in (1, 2, 1)]
    assert found[0] == found[2] != found[1]
    assert all(len(task.places) == 3 for task in found)
    assert env.task == found[2] and env.reward.task == found[2] and env.reward.dense
    env.close()


def test_given_places_are_kept_and_are_as_many_as_objects() -> None:
    given = {"places": [[0.5, 0.1], [0.4, -0.2]]}
    env = PushingEnv(task="rearrange", tiles=given, objects=2)
    assert env.reset(seed=4)[1]["task"].places == PLACES
    env.close()
    with pytest.raises(ValueError, match="number of places is 2, of objects 3: use objects=2"):
        PushingEnv(task="rearrange", tiles=given, objects=3).reset(seed=4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"places": [3]}, r"places must be points in metres such as \[\[0\.5, 0\.1\], \[0\.4, -0\.2\]\], not \[3\]$"),
        ({"places": [[0.5, 0.1]] * 11}, r"places must be at most 10 points, not 11$"),
        ({"goal": "a.png"}, r"unknown key 'goal', valid keys are task, region, "),
    ],
)
def test_what_is_no_rearrangement_is_refused_in_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        parse_task("rearrange", {**{name: list(tiles) for name, tiles in LAYOUT.items()}, **change})
