"""The large maze: as Gymnasium wants it, the same by seed, and its walls stop the ball."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cavin_pyro.envs.maze import REACHED, Maze
from cavin_pyro.envs.world import check_world

pytest.importorskip("gymnasium_robotics")
pytestmark = pytest.mark.filterwarnings("ignore")  # of Gymnasium's checker, and of the simulator's older environments


@pytest.fixture(scope="module")
def env() -> Any:
    env = Maze()
    yield env
    env.close()


def test_it_is_an_environment_and_a_world(env: Maze) -> None:
    check_env(env, skip_render_check=True)
    check_world(env)
    assert env.render() is None
    env.render_mode = "rgb_array"
    (column, row), picture = env.pixels(env.reset(seed=1)[0][:2]).astype(int), env.render()
    assert picture[row, column].tolist() == [200, 60, 60] and picture[0, 0].tolist() == [90, 90, 90]  # ball and wall
    env.render_mode = None


def test_the_seed_and_the_policy_determine_an_episode_which_wanders_through_the_maze(env: Maze) -> None:
    paths = []
    for _ in range(2):
        observation, _ = env.reset(seed=5)
        policy, path = env.policy(np.random.default_rng(5)), [observation]
        for _ in range(60):
            action = policy.act(path[-1]).astype(np.float32)
            assert env.action_space.contains(action)
            path.append(env.step(action)[0])
        paths.append(np.stack(path))
    np.testing.assert_array_equal(*paths)
    cells = {tuple(np.floor(place).astype(int)) for place in paths[0][:, :2]}
    assert len(cells) > 6


def test_goals_are_far_and_reached_within_their_radius(env: Maze) -> None:
    for seed in range(5):
        observation, info = env.reset(seed=seed)
        ends = [env._simulator.maze.cell_xy_to_rowcol(place) for place in (observation[:2], info["goal"])]
        assert len(env.ways[tuple(tuple(map(int, cell)) for cell in ends)]) >= 10  # type: ignore[index]
        goal, state = env.goal(), env.state(observation)
        assert not goal.success(state)
        for away, reached in ((0.7 * REACHED, True), (REACHED, False)):
            state.centers[0] = state.centers.new_tensor(info["goal"] + [away, 0.0])
            assert bool(goal.success(state)) is reached


def test_a_wall_stops_the_ball_and_the_goal_ends_the_episode(env: Maze) -> None:
    observation, _ = env.reset(seed=0)
    for _ in range(30):
        observation, *_ = env.step(np.array([0.0, 1.0], np.float32))
    walled, *_ = env.step(np.array([0.0, 1.0], np.float32))
    assert abs(walled[1] - observation[1]) < 0.01 and abs(walled[3]) < 0.1
    env.reset(seed=0)
    env.place = env._simulator.reset_pos  # where it is
    _, reward, terminated, truncated, told = env.step(np.zeros(2, np.float32))
    assert (reward, terminated, truncated, told) == (1.0, True, False, {"success": True})


@pytest.mark.parametrize(
    ("options", "said"),
    [({"maximum_steps": 0}, "not 0$"), ({"cells": 30}, "not 30$"), ({"render_mode": "human"}, "'human'")],
)
def test_what_it_cannot_be_is_one_line(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Maze(**options)
