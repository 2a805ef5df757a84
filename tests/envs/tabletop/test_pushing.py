"""The Gymnasium environment."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cavin_pyro.envs.tabletop.layouts import layout_numbers
from cavin_pyro.envs.tabletop.objects.sampling import ObjectParameters, ObjectRanges
from cavin_pyro.envs.tabletop.observation import Observation
from cavin_pyro.envs.tabletop.policy import HeuristicPushingPolicy
from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.envs.tabletop.tasks import TASKS, TaskReward
from cavin_pyro.envs.tabletop.tasks.crossing import Crossing
from cavin_pyro.envs.tabletop.workspace import TABLE_HIGH, TABLE_LOW, normalised_push, tile_center

NOTHING = np.array([-1.0, -1.0, 0.0, 0.0], dtype=np.float32)  # in a corner where no builtin task starts objects
LYING_ALONG_Y = (-0.5, -0.5, -0.5, 0.5)
BRIDGE = Crossing(
    region=[(2, 2), (2, 3), (2, 4)], goal=[(2, 2)], target_start=[(2, 4)], obstacle_start=[(1, 3), (3, 3)]
)
Make = Callable[..., PushingEnv]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Environments that are closed when the test ends."""
    made: list[PushingEnv] = []

    def build(*objects: ObjectParameters, **options: Any) -> PushingEnv:
        """With `objects`, exactly these lie on the table after a reset."""
        env = PushingEnv(**options)
        made.append(env)
        if objects:
            monkeypatch.setattr(
                env.scene, "sample", lambda *_, **__: env.scene.reset(objects, np.random.default_rng(0))
            )
        return env

    yield build
    for env in made:
        env.close()


def observation(observed: dict[str, np.ndarray]) -> Observation:
    return Observation(
        observed["clouds"], observed["centers"], observed["mask"].astype(bool), observed["visible"].astype(bool)
    )


def assert_equal(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    assert set(one) == set(other) == {"clouds", "centers", "mask", "visible"}
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])


def test_a_step_reports_all_that_happened(make: Make) -> None:
    env = make(objects=2)
    observed, info = env.reset(seed=1)
    assert env.observation_space.contains(observed) and info == {"steps": 0, "task": env.task}
    observed, reward, terminated, truncated, info = env.step(NOTHING)
    assert env.observation_space.contains(observed)
    told = {"steps", "unsafe", "ineffective", "stopped", "success", "violation", "fall", "terms", "strict"}
    assert set(info) == told
    assert info["strict"] == {"success": False, "violation": False, "fall": False, "reward": -1}
    assert info["terms"] == {"goal": 0, "violation": 0, "time": -1, "progress": 0}
    assert (reward, terminated, truncated) == (-1, False, False)
    assert info["ineffective"] and not any(info[name] for name in ("unsafe", "success", "violation", "fall"))


LAYOUTS = [(task, number) for task in TASKS for number in layout_numbers(task)]


@pytest.mark.parametrize(
    ("task", "layout"), [*LAYOUTS, ("clearing", "hard"), ("insertion", "hard"), ("crossing", "hard")]
)
def test_objects_start_on_their_tiles_in_an_episode_still_to_be_played(make: Make, task: str, layout: Any) -> None:
    env = make(task=task, layout=layout, objects=3)
    observed, _ = env.reset(seed=0)
    centers = torch.from_numpy(observed["centers"])
    outcome = TaskReward(env.task)(centers, centers, torch.from_numpy(observed["mask"] == 1))
    assert not outcome.success and not outcome.failure
    starts = [env.task.target_start, env.task.obstacle_start, env.task.obstacle_start]
    for center, tiles in zip(observed["centers"][:3], starts, strict=True):
        nearest = min(np.abs(center[:2] - tile_center(tile)).max() for tile in tiles)
        assert nearest < 0.075 + 0.06  # within a tile, and some centimetres of rolling until rest


@pytest.mark.parametrize("task", TASKS)
def test_the_reward_is_the_task_reward_of_the_observations(make: Make, task: str) -> None:
    env = make(task=task, objects=4, reward="dense", ranges=ObjectRanges(clearance=0.1))
    policy = HeuristicPushingPolicy(np.random.default_rng(1))
    changed = 0
    observed, _ = env.reset(seed=2)
    for _ in range(6):
        before, imagined = observed, TaskReward(env.task, reward="dense")
        observed, reward, terminated, _, info = env.step(policy.act(observation(observed)).astype(np.float32))
        previous, centers = (torch.from_numpy(one["centers"]) for one in (before, observed))
        outcome = imagined(previous, centers, torch.from_numpy(observed["mask"] == 1))
        assert reward == pytest.approx(sum(info["terms"].values()))
        if not info["fall"]:  # an object that has fallen is out of sight: only the simulator knows
            assert reward == pytest.approx(outcome.reward.item(), abs=1e-5)
            assert info["success"] == bool(outcome.success) and info["violation"] == bool(outcome.violation)
            assert terminated == bool(outcome.success | outcome.failure)
        changed += not info["ineffective"]
        if terminated:
            observed, _ = env.reset()
    assert changed >= 1


def test_an_environment_has_no_copy_that_would_close_its_simulation(make: Make) -> None:
    env = make(objects=1)
    for one in (env, env.scene, env.scene.world):
        for copied in (copy.copy, copy.deepcopy):
            with pytest.raises(TypeError, match="a simulation cannot be copied: make a second environment"):
                copied(one)


def test_an_episode_is_cut_off_after_its_steps(make: Make) -> None:
    env = make(objects=1, maximum_steps=2)
    env.reset(seed=0)
    assert [env.step(NOTHING)[2:4] for _ in range(2)] == [(False, False), (False, True)]
    assert make().maximum_steps == 60


def test_pushing_the_target_to_the_goal_ends_the_episode_with_success(make: Make, put: Callable) -> None:
    x, y = tile_center((2, 3))
    env = make(put("rubiks_cube", x, y - 0.03), task=BRIDGE, objects=1, reward="dense")
    env.reset(seed=0)
    push = normalised_push(np.array([x, y + 0.04]), np.array([0.0, -0.1])).astype(np.float32)
    _, reward, terminated, truncated, info = env.step(push)
    assert info["success"] and terminated and not truncated
    assert info["terms"]["goal"] == 100 and 0.04 < info["terms"]["progress"] < 0.08
    assert reward == pytest.approx(99 + info["terms"]["progress"])


def test_by_the_published_criterion_the_same_push_goes_on_and_tells_the_strict_end(make: Make, put: Callable) -> None:
    x, y = tile_center((2, 4))
    push = normalised_push(np.array([x - 0.02, y]), np.array([0.1, 0.0])).astype(np.float32)
    seen = {}
    for criterion in ("strict", "published"):
        env = make(put("rubiks_cube", x + 0.05, y), task=BRIDGE, objects=1, criterion=criterion)
        first, _ = env.reset(seed=0)
        observed, reward, terminated, _, info = env.step(push)
        seen[criterion] = first["clouds"], observed["clouds"]
        assert terminated == (criterion == "strict") and reward == (-101 if terminated else -1)
        assert info["strict"] == {"success": False, "violation": True, "fall": False, "reward": -101}
    for one, other in zip(*seen.values(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_object_off_the_table_ends_the_episode_with_a_fall(make: Make, put: Callable) -> None:
    x, y = tile_center((2, 3))
    box = put("sugar_box", 0.55, 0.50, orientation=LYING_ALONG_Y)
    env = make(put("rubiks_cube", x, y), box, task=BRIDGE, objects=2)
    env.reset(seed=0)
    for start in (0.39, 0.43, 0.46, 0.49):
        push = normalised_push(np.array([0.55, start]), np.array([0.0, 0.1])).astype(np.float32)
        observed, reward, terminated, truncated, info = env.step(push)
        assert info["fall"] == terminated
        if terminated:
            break
    assert info["fall"] and not truncated and reward == -101 and not info["success"] and not info["violation"]
    assert env.observation_space.contains(observed)
    assert (observed["visible"][:2].tolist(), observed["mask"][:2].tolist()) == ([1, 0], [1, 1])
    assert observed["centers"][1, 1] > 0.4  # its latest cloud stays


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"objects": 11}, r"^objects must be a whole number of at least 1 and at most 10, not 11$"),
        ({"margin": "x"}, r"^margin must be of type float, not 'x'$"),
        ({"tiles": 3}, r"^tiles must be of type Mapping.*, not 3$"),
        ({"ranges": {"mas": 3}}, "^unknown option 'mas' of ranges: choose from names, scale, mass, "),
        ({"camera": 3}, r"^camera must be of type str . Camera . DepthSensor, not 3$"),
        ({"camera": "webcam"}, r"^unknown camera 'webcam': choose from ideal, kinect2$"),
        ({"object_set": "toys"}, r"^unknown object set 'toys': choose from builtin, ycb, mixed, random$"),
        ({"task": BRIDGE, "tiles": {"goal": [[2, 3]]}}, r"^a task object has its own layout"),
    ],
)
def test_a_bad_argument_gets_its_one_line(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        PushingEnv(**options)
    assert "\n" not in str(caught.value)


NUMBERS = st.one_of(st.floats(-1.0, 1.0), st.floats(width=32))  # as policies give them, and any at all


@pytest.fixture(scope="module")
def crowded() -> Iterator[PushingEnv]:
    made = PushingEnv(task="clearing", objects=4, maximum_steps=10**6)
    made.reset(seed=0)
    yield made
    made.close()


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.lists(NUMBERS, min_size=4, max_size=4))
@example([np.nan, 0.0, 0.0, 0.0])
@example([0.0, 0.0, -np.inf, 0.0])
@example([1e30, -1e30, 1e30, 1e30])
def test_any_four_numbers_are_carried_out_in_the_reach_or_refused(crowded: PushingEnv, numbers: list[float]) -> None:
    env = crowded
    action, steps, before = np.array(numbers, dtype=np.float32), env._steps, env.scene.ground_truth().positions
    if not np.isfinite(action).all():
        with pytest.raises(ValueError, match="4 finite numbers"):
            env.step(action)
        np.testing.assert_array_equal(env.scene.ground_truth().positions, before)
        assert env._steps == steps
        return
    observed, reward, terminated, _, info = env.step(action)
    assert env.observation_space.contains(observed) and np.isfinite(reward)
    after = env.scene.ground_truth().positions
    on_table = ((after[:, :2] > TABLE_LOW) & (after[:, :2] < TABLE_HIGH)).all(axis=-1)
    assert (after[on_table, 2] > 0.0).all()  # through the table nothing goes
    if info["unsafe"]:
        np.testing.assert_array_equal(after, before)
    assert np.linalg.norm((after - before)[on_table], axis=-1).max(initial=0.0) < 0.3  # the tool goes 0.14 m at most
    if terminated:
        env.reset()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_each_environment_of_several_goes_on_as_it_does_alone(mode: str) -> None:
    """Over the end of an episode: the step after it resets, as `AutoresetMode.NEXT_STEP` says."""
    name, options, seeds = "cavin/Crossing-v0", {"objects": 2, "maximum_steps": 2}, [5, 6]
    envs = gymnasium.make_vec(name, num_envs=2, vectorization_mode=mode, **options)
    alone = [gymnasium.make(name, **options) for _ in seeds]
    together, _ = envs.reset(seed=seeds)
    one = [env.reset(seed=seed)[0] for env, seed in zip(alone, seeds, strict=True)]
    ended = [False, False]
    for actions in np.random.default_rng(0).uniform(-1, 1, size=(4, 2, 4)).astype(np.float32):
        for number in range(2):
            assert_equal({key: values[number] for key, values in together.items()}, one[number])
        together, rewards, terminated, truncated, _ = envs.step(actions)
        for number, env in enumerate(alone):
            if ended[number]:
                one[number], reward, ends = env.reset()[0], 0.0, (False, False)
            else:
                one[number], reward, *ends, _ = env.step(actions[number])
            assert (rewards[number], terminated[number], truncated[number]) == (reward, *ends)
            ended[number] = any(ends)
    for env in (envs, *alone):
        env.close()
