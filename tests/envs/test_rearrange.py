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
from envs.layouts import parse_task
from envs.pushing import PushingEnv
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


def test_dense_progress_is_the_way_that_objects_came_closer_to_their_places() -> None:
    before, after = states((0.5, 0.3), (0.4, -0.5)), states((0.5, 0.2), (0.4, -0.55))
    outcome = TaskReward(TASK, reward="dense")(before, after, MASK)
    assert outcome.terms["progress"].item() == pytest.approx(0.1 - 0.05, abs=1e-6)


def test_every_seed_has_places_of_its_own_and_always_the_same(env: PushingEnv) -> None:
    found = [env.reset(seed=seed)[1]["task"] for seed in (1, 2, 1)]
    assert found[0] == found[2] != found[1]
    assert all(len(task.places) == 3 for task in found)
    assert env.task == found[2] and env.reward.task == found[2] and env.reward.dense


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
