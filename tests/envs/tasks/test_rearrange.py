"""Rearranging: every object has to reach its place."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from envs.goals import save_goal
from envs.layouts import load_task, parse_task
from envs.markings import PLACE_RADIUS
from envs.pushing import PushingEnv
from envs.sensors.camera import Camera
from envs.tasks import Outcome, TaskReward
from envs.tasks.rearrange import LEAST_TOLERANCE, TOLERANCE, Rearrange

LAYOUT = {"region": [(1, 3)], "target_start": [(1, 1)], "obstacle_start": [(1, 5)]}
PLACES = ((0.5, 0.1), (0.4, -0.2))
TASK = Rearrange(places=PLACES, **LAYOUT)
MASK = torch.tensor([True, True])

offsets = st.floats(0.0, 0.08)
angles = st.floats(-np.pi, np.pi)


def states(*points: tuple[float, float]) -> torch.Tensor:
    return torch.tensor([[*point, 0.03] for point in points], dtype=torch.float64)


def away(place: tuple[float, float], distance: float, angle: float) -> tuple[float, float]:
    return place[0] + distance * np.cos(angle), place[1] + distance * np.sin(angle)


def judge(*points: tuple[float, float], task: Rearrange = TASK, **options: Any) -> Outcome:
    after = states(*points)
    return TaskReward(task, **options)(states(*[(0.6, 0.3)] * len(points)), after, torch.ones(len(points)) > 0)


@pytest.fixture
def env() -> Iterator[PushingEnv]:
    made = PushingEnv(task="rearrange", reward="dense", render_mode="rgb_array")
    yield made
    made.close()


@given(offsets, offsets, angles, angles)
def test_it_succeeds_when_every_object_is_within_the_tolerance(one: float, other: float, a: float, b: float) -> None:
    points = away(PLACES[0], one, a), away(PLACES[1], other, b)
    if min(abs(one - TOLERANCE), abs(other - TOLERANCE)) > 1e-9:
        assert bool(judge(*points).success) == (one < TOLERANCE and other < TOLERANCE)
    assert bool(judge(*points, margin=0.0).success) >= bool(judge(*points, margin=0.01).success)


def test_a_margin_asks_planners_for_more_but_never_for_the_impossible() -> None:
    assert judge(away(PLACES[0], 0.019, 1.0), PLACES[1], margin=0.01).success
    assert not judge(away(PLACES[0], 0.021, 1.0), PLACES[1], margin=0.01).success
    for margin in (0.02, 0.05, 1.0):
        assert judge(away(PLACES[0], 0.9 * LEAST_TOLERANCE, 1.0), PLACES[1], margin=margin).terms["goal"] == 100.0 or (
            margin > 0.1  # the whole table is then too near to its edge
        )
        assert not judge(away(PLACES[0], 1.1 * LEAST_TOLERANCE, 1.0), PLACES[1], margin=margin).success


def test_planners_keep_objects_within_the_tools_reach_away_from_their_places() -> None:
    out_of_reach = (0.82, 0.3)  # the tool reaches x up to 0.80
    assert judge(out_of_reach, PLACES[1], margin=0.01).violation
    assert not judge(out_of_reach, PLACES[1]).violation  # the environment forbids nothing
    there = Rearrange(places=(out_of_reach, PLACES[1]), **LAYOUT)
    assert not judge(out_of_reach, PLACES[1], task=there, margin=0.01).violation


def test_a_place_is_of_one_object() -> None:
    assert judge(*PLACES).success
    assert not judge(*PLACES[::-1]).success


def test_padding_has_no_place() -> None:
    points = states(*PLACES, (0.9, 0.5))
    outcome = TaskReward(TASK)(points, points, torch.tensor([True, True, False]))
    assert outcome.success
    assert TASK.potential(points[..., :2], torch.tensor([True, True, False])).item() == pytest.approx(0.0, abs=1e-6)


def test_an_object_off_the_table_is_the_only_failure() -> None:
    assert judge((0.30, 0.55), (0.9, -0.5)).failure.item() is False
    assert judge(PLACES[0], (0.9, -0.7)).fall


def test_dense_progress_is_the_way_that_objects_came_closer_to_their_places() -> None:
    before, after = states((0.5, 0.3), (0.4, -0.5)), states((0.5, 0.2), (0.4, -0.55))
    outcome = TaskReward(TASK, reward="dense")(before, after, MASK)
    assert outcome.terms["progress"].item() == pytest.approx(0.1 - 0.05, abs=1e-6)


@given(st.lists(st.tuples(offsets, angles), min_size=4, max_size=4))
def test_progress_adds_up_to_the_same_on_every_way(ends: list[tuple[float, float]]) -> None:
    way = torch.stack([states(away(PLACES[0], *end), away(PLACES[1], *end)) for end in ends])
    terms = TaskReward(TASK, reward="dense").along(way, MASK).terms["progress"].sum()
    whole = TaskReward(TASK, reward="dense")(way[0], way[-1], MASK).terms["progress"]
    torch.testing.assert_close(terms, whole)


def test_any_leading_dimensions_are_judged_alike() -> None:
    way = torch.rand(4, 5, 7, 2, 3, dtype=torch.float64)
    both = TaskReward(TASK, reward="dense").along(way, MASK)
    assert both.reward.shape == (4, 5, 6)
    one = TaskReward(TASK, reward="dense")(way[2, 3, 4], way[2, 3, 5], MASK)
    assert both.reward[2, 3, 4] == one.reward


# Episodes.


def test_every_seed_has_places_of_its_own_and_always_the_same(env: PushingEnv) -> None:
    found = [env.reset(seed=seed)[1]["task"] for seed in (1, 2, 1)]
    assert found[0] == found[2] != found[1]
    assert all(len(task.places) == 3 for task in found)
    assert env.task == found[2] and env.reward.task == found[2] and env.reward.dense


def test_scenes_do_not_depend_on_the_goal(env: PushingEnv, tmp_path: Path) -> None:
    observed, info = env.reset(seed=4)
    save_goal(tmp_path / "goal.safetensors", env.scene)
    env.step(np.array([0.1, 0.2, 0.9, -0.4], dtype=np.float32))
    other = PushingEnv(task="rearrange", tiles={"places": [[0.5, 0.1], [0.4, -0.2], [0.6, 0.3]]})
    again, changed = other.reset(seed=4)
    other.close()
    np.testing.assert_array_equal(observed["clouds"], again["clouds"])
    assert info["task"].places != changed["task"].places == ((0.5, 0.1), (0.4, -0.2), (0.6, 0.3))


@pytest.mark.parametrize("suffix", [".png", ".safetensors"])
def test_the_places_of_a_file_are_those_of_its_objects(suffix: str, env: PushingEnv, tmp_path: Path) -> None:
    env.reset(seed=4)
    for push in ((0.1, 0.2, 0.9, -0.4), (-0.2, -0.5, 0.2, 0.9)):
        env.step(np.array(push, dtype=np.float32))
    save_goal(tmp_path / f"goal{suffix}", env.scene)
    shown = env.scene.observe().centers[:3]
    told = PushingEnv(task="rearrange", tiles={"goal": str(tmp_path / f"goal{suffix}")})
    _, info = told.reset(seed=4)  # the same objects, as they stood before the pushes
    told.close()
    np.testing.assert_allclose(info["task"].places, shown[:, :2], atol=0.01)


def test_a_file_with_another_number_of_objects_is_refused(env: PushingEnv, tmp_path: Path) -> None:
    env.reset(seed=4)
    save_goal(tmp_path / "goal.png", env.scene)
    for objects in (2, 4):
        other = PushingEnv(task="rearrange", tiles={"goal": str(tmp_path / "goal.png")}, objects=objects)
        with pytest.raises(
            ValueError, match=rf"goal\.png: number of places is 3, of objects {objects}: use objects=3$"
        ):
            other.reset(seed=4)
        other.close()


def test_an_episode_does_not_begin_where_it_would_end(tmp_path: Path) -> None:
    env = PushingEnv(task="rearrange", objects=1)
    first, _ = env.reset(seed=4)
    save_goal(tmp_path / "goal.safetensors", env.scene)
    env.close()
    env = PushingEnv(task="rearrange", objects=1, tiles={"goal": str(tmp_path / "goal.safetensors")})
    second, info = env.reset(seed=4)
    env.close()
    np.testing.assert_allclose(info["task"].places[0], first["centers"][0, :2], atol=0.01)
    assert np.linalg.norm(second["centers"][0, :2] - info["task"].places[0]) > TOLERANCE


def test_pictures_show_a_disc_in_the_colour_of_each_object(env: PushingEnv) -> None:
    for seed in range(5):
        env.reset(seed=seed)
        picture = env.render()
        env.scene.places = ()
        plain = env.render()
        changed = (picture != plain).any(axis=-1)
        camera = Camera().resized(*changed.shape[::-1])
        radius = PLACE_RADIUS * camera.focal_length / camera.position[2]
        rows, columns = np.nonzero(changed)
        pixels = [camera.project(np.array([*place, 0.0])) for place in env.task.places]
        assert 0.5 < changed.sum() / (3 * np.pi * radius**2) < 1.1  # objects may hide some of it
        distances = [np.hypot(columns - pixel[0], rows - pixel[1]) for pixel in pixels]
        assert np.min(distances, axis=0).max() < radius + 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"places": 3}, r"places must be a list of points such as \[\[0\.5, 0\.1\], \[0\.4, -0\.2\]\], not 3$"),
        ({"places": [3]}, r"places: a point is two numbers in metres such as \[0\.5, 0\.1\], not 3$"),
        ({"places": [[1, 2, 3]]}, r"places: a point is two numbers"),
        ({"places": [["a", 2]]}, r"places: a point is two numbers"),
        ({"places": [[float("nan"), 0.1]]}, r"places: \[nan, 0\.1\] is off the table"),
        ({"places": [[0.1, 0.1]]}, r"places: \[0\.1, 0\.1\] is off the table, from \[0\.22, -0\.61\] to"),
        ({"places": [[0.5, 0.1]] * 11}, r"places must be at most 10 points, not 11$"),
        ({"goal": [[1, 2]]}, r"goal must be the path of a file, not \[\[1, 2\]\]$"),
        ({"goal": "a.png", "places": [(0.5, 0.1)]}, r"goal a\.png and places both say .*: give one of them$"),
        ({"goal": "nowhere.png"}, r"goal nowhere\.png cannot be read: No such file or directory$"),
        ({"clearance": -1}, r"clearance must be at least 0 metres, not -1$"),
        ({"clearance": "wide"}, r"clearance must be at least 0 metres, not 'wide'$"),
        ({"region": []}, r"region needs at least one tile$"),
    ],
)
def test_what_is_no_rearrangement_is_refused_in_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=rf"^layout: {message}"):
        parse_task("rearrange", {**{name: list(tiles) for name, tiles in LAYOUT.items()}, **change})


def test_its_layout_has_room_for_five_objects() -> None:
    env = PushingEnv(task="rearrange", objects=5)
    observed, info = env.reset(seed=0)
    assert observed["mask"].all() and len(info["task"].places) == 5
    assert info["task"].region == load_task("rearrange").region
    env.close()
