"""Rearranging: goals from files or at random, which place is whose, and rewards."""

from __future__ import annotations

import io
import pickle
from itertools import combinations, permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from cavin_pyro.envs.tabletop.goals import LARGEST, SHAPE_WEIGHT, Goal, assign, read_goal, sample_places, save_goal
from cavin_pyro.envs.tabletop.layouts import parse_task
from cavin_pyro.envs.tabletop.observation import Observation
from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.envs.tabletop.tasks import Outcome, TaskReward
from cavin_pyro.envs.tabletop.tasks.rearrange import LEAST_TOLERANCE, TOLERANCE, Rearrange
from cavin_pyro.envs.tabletop.workspace import OBJECT_SLOTS, POINTS_PER_OBJECT, TILE_SIDE, tile_center

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


@settings(deadline=None, max_examples=20)
@given(st.permutations(range(3)), st.lists(points, min_size=6, max_size=6), st.lists(angles, min_size=6, max_size=6))
def test_objects_that_differ_go_where_the_goal_shows_them_however_far_and_turned(
    order: list[int], places: list[tuple[float, float]], turns: list[float]
) -> None:
    shown = [cloud(SHAPES[kind], places[number], turns[number], seed=number) for number, kind in enumerate(order)]
    starts = [cloud(shape, places[3 + kind], turns[3 + kind], seed=9 + kind) for kind, shape in enumerate(SHAPES)]
    found = assign(observed(*starts), goal(*shown))
    for kind, place in enumerate(found):
        np.testing.assert_allclose(place, shown[order.index(kind)].mean(axis=0)[:2], atol=1e-6)


@settings(deadline=None, max_examples=20)
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


FLAT = np.ones((212, 256))  # metres: an empty table


def png(values: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(values).save(buffer, "PNG")
    return buffer.getvalue()


REFUSED = [
    ("goal.pt", pickle.dumps(FLAT), r"must be a file that ends in \.png$"),
    ("goal.png", png((1000 * FLAT).astype(np.uint16)), r"shows 0 objects on the table, and a scene holds 1 to 10$"),
    ("goal.png", png(np.zeros((212, 256), np.uint8)), r"16 bits of depth per pixel, in millimetres, not L$"),
    ("goal.png", png(np.zeros((1, 5000), np.uint16)), r"is over 2048 pixels wide or high$"),
    ("goal.png", png((1000 * FLAT).astype(np.uint16))[:-60], r"is damaged or no PNG"),
    ("goal.png", bytes(LARGEST + 1), r"has over \d+ bytes$"),
]


@pytest.mark.parametrize(("name", "content", "message"), REFUSED)
def test_what_is_no_goal_is_refused_in_one_line(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_goal(tmp_path / name)
    assert str(caught.value).startswith(f"goal {tmp_path / name} ")
    assert "\n" not in str(caught.value)


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


def test_the_places_of_a_file_are_those_of_its_objects(tmp_path: Path) -> None:
    env = PushingEnv(task="rearrange")
    env.reset(seed=4)
    for push in ((0.1, 0.2, 0.9, -0.4), (-0.2, -0.5, 0.2, 0.9)):
        env.step(np.array(push, dtype=np.float32))
    save_goal(tmp_path / "goal.png", env.scene)
    shown = env.scene.observe().centers[:3]
    told = PushingEnv(task="rearrange", tiles={"goal": str(tmp_path / "goal.png")})
    _, info = told.reset(seed=4)  # the same objects, as they stood before the pushes
    for one in (env, told):
        one.close()
    np.testing.assert_allclose(info["task"].places, shown[:, :2], atol=0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"places": [3]}, r"places must be points in metres such as \[\[0\.5, 0\.1\], \[0\.4, -0\.2\]\], not \[3\]$"),
        ({"places": [[0.5, 0.1]] * 11}, r"places must be at most 10 points, not 11$"),
        ({"goal": "a.png", "places": [(0.5, 0.1)]}, r"goal a\.png and places both say .*: give one of them$"),
    ],
)
def test_what_is_no_rearrangement_is_refused_in_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=rf"^layout: {message}"):
        parse_task("rearrange", {**{name: list(tiles) for name, tiles in LAYOUT.items()}, **change})
