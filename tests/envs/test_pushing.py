"""The Gymnasium environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
import yaml
from gymnasium.utils.env_checker import check_env

from envs.layouts import layout_numbers, load_task
from envs.objects.sampling import ObjectParameters, ObjectRanges
from envs.observation import Observation
from envs.policy import HeuristicPushingPolicy
from envs.pushing import EPISODE_STEPS, PushingEnv
from envs.scene import PushReport
from envs.tasks import TASKS, TaskReward
from envs.tasks.crossing import Crossing
from envs.workspace import normalised_push, tile_center

NOTHING = np.array([-1.0, -1.0, 0.0, 0.0], dtype=np.float32)  # in a corner where no builtin task starts objects
LYING_ALONG_Y = (-0.5, -0.5, -0.5, 0.5)
KNOWN_TASKS = ", ".join(TASKS)
TILES = {
    "region": [[2, 2], [2, 3], [2, 4]],
    "goal": [[2, 2]],
    "target_start": [[2, 4]],
    "obstacle_start": [[1, 3], [3, 3]],
}
BRIDGE = Crossing(**TILES)
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


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_finds_nothing_wrong(task: str) -> None:
    env = gymnasium.make(f"cavin/{task.capitalize()}-v0", render_mode="rgb_array")
    assert isinstance(env.unwrapped, PushingEnv) and env.unwrapped.task.name == task
    check_env(env.unwrapped)  # what it warns of is an error here
    env.close()


@pytest.mark.parametrize(("objects", "slots"), [(3, 5), (5, 5), (6, 6), (10, 10)])
def test_observations_have_room_for_five_objects_or_for_all_that_there_are(objects: int, slots: int) -> None:
    env = gymnasium.make("cavin/Crossing-v0", objects=objects)
    assert env.observation_space["clouds"].shape == (slots, 256, 3)
    observed, _ = env.reset(seed=10000)
    assert observed["mask"].tolist() == observed["visible"].tolist() == [1] * objects + [0] * (slots - objects)
    if objects == 10:
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_environments_can_be_stepped_side_by_side() -> None:
    envs = gymnasium.make_vec("cavin/Insertion-v0", num_envs=2, vectorization_mode="sync", objects=2)
    observed, _ = envs.reset(seed=0)
    assert observed["clouds"].shape == (2, 5, 256, 3)
    assert not np.array_equal(observed["centers"][0], observed["centers"][1])
    _, reward, terminated, truncated, info = envs.step(np.stack([NOTHING, NOTHING]))
    np.testing.assert_array_equal(reward, [-1, -1])
    assert not terminated.any() and not truncated.any() and info["ineffective"].all()
    envs.close()


# What comes back.


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


@pytest.mark.parametrize("objects", range(1, 6))
def test_one_to_five_objects_can_be_asked_for(make: Make, objects: int) -> None:
    env = make(task="clearing", objects=objects)
    observed, _ = env.reset(seed=objects)
    assert observed["mask"].tolist() == observed["visible"].tolist() == [1] * objects + [0] * (5 - objects)
    assert env.observation_space.contains(env.step(NOTHING)[0])


@pytest.mark.parametrize(("task", "layout"), [(task, number) for task in TASKS for number in layout_numbers(task)])
def test_objects_start_on_their_tiles_in_an_episode_still_to_be_played(make: Make, task: str, layout: int) -> None:
    env = make(task=task, layout=layout, objects=3)
    reward = TaskReward(env.task)
    for seed in range(3):
        observed, _ = env.reset(seed=seed)
        centers = torch.from_numpy(observed["centers"])
        outcome = reward(centers, centers, torch.from_numpy(observed["mask"] == 1))
        assert not outcome.success and not outcome.failure
        starts = [env.task.target_start, env.task.obstacle_start, env.task.obstacle_start]
        for center, tiles in zip(observed["centers"][:3], starts, strict=True):
            nearest = min(np.abs(center[:2] - tile_center(tile)).max() for tile in tiles)
            assert nearest < 0.075 + 0.06  # within a tile, and some centimetres of rolling until rest


def test_a_scene_in_which_the_target_has_rolled_off_the_bridge_is_sampled_anew(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make(layout=0, objects=1)
    samples, reset = [], env.scene.reset
    monkeypatch.setattr(env.scene, "reset", lambda *args: samples.append(reset(*args)) or samples[-1])
    reward, started = TaskReward(env.task), 40
    for seed in range(started):
        center = torch.from_numpy(env.reset(seed=seed)[0]["centers"][:1])
        assert not reward(center, center, torch.tensor([True])).failure
    assert started < len(samples) < 2 * started


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_the_reward_is_the_task_reward_of_the_observations(make: Make, task: str, kind: str) -> None:
    env = make(task=task, objects=4, reward=kind, ranges=ObjectRanges(clearance=0.1))
    policy = HeuristicPushingPolicy(np.random.default_rng(1))
    changed = 0
    observed, _ = env.reset(seed=2)
    for _ in range(10):
        before, imagined = observed, TaskReward(env.task, reward=kind)
        observed, reward, terminated, _, info = env.step(policy.act(observation(observed)).astype(np.float32))
        outcome = imagined(
            torch.from_numpy(before["centers"]),
            torch.from_numpy(observed["centers"]),
            torch.from_numpy(observed["mask"] == 1),
        )
        assert reward == pytest.approx(sum(info["terms"].values()))
        if not info["fall"]:  # an object that has fallen is out of sight: only the simulator knows
            assert reward == pytest.approx(outcome.reward.item(), abs=1e-5)
            assert info["success"] == bool(outcome.success) and info["violation"] == bool(outcome.violation)
            assert terminated == bool(outcome.success | outcome.failure)
        changed += not info["ineffective"]
        if terminated:
            observed, _ = env.reset()
    assert changed >= 1


# How episodes end.


def test_an_episode_is_cut_off_after_its_steps(make: Make) -> None:
    env = make(objects=1, maximum_steps=3)
    for seed in (0, 1):
        env.reset(seed=seed)
        ends = [env.step(NOTHING)[2:4] for _ in range(3)]
        assert ends == [(False, False), (False, False), (False, True)]


def test_an_episode_has_sixty_steps_by_default(make: Make) -> None:
    assert EPISODE_STEPS == 60
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


def test_pushing_the_target_off_the_bridge_ends_the_episode_with_a_violation(make: Make, put: Callable) -> None:
    x, y = tile_center((2, 4))
    env = make(put("rubiks_cube", x + 0.05, y), task=BRIDGE, objects=1)
    env.reset(seed=0)
    push = normalised_push(np.array([x - 0.02, y]), np.array([0.1, 0.0])).astype(np.float32)
    _, reward, terminated, _, info = env.step(push)
    assert info["violation"] and terminated and reward == -101
    assert not info["success"] and not info["fall"]


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
    with pytest.raises(ValueError, match="^unknown criterion 'lax': choose from strict, published$"):
        make(criterion="lax")


def test_an_object_off_the_table_ends_the_episode_with_a_fall(make: Make, put: Callable) -> None:
    x, y = tile_center((2, 3))
    box = put("sugar_box", 0.55, 0.50, orientation=LYING_ALONG_Y)
    env = make(put("rubiks_cube", x, y), box, task=BRIDGE, objects=2)
    env.reset(seed=0)
    infos = []
    for start in (0.39, 0.43, 0.46, 0.49):
        push = normalised_push(np.array([0.55, start]), np.array([0.0, 0.1])).astype(np.float32)
        observed, reward, terminated, truncated, info = env.step(push)
        infos.append(info)
        if terminated:
            break
    assert info["fall"] and terminated and not truncated and reward == -101
    assert not info["success"] and not info["violation"]
    assert not any(one["fall"] for one in infos[:-1])
    assert env.observation_space.contains(observed)


@pytest.mark.parametrize(("place", "otherwise"), [((2, 2), "success"), ((4, 4), "violation")])
def test_a_fall_that_the_camera_cannot_see_outweighs_what_it_sees(
    make: Make, put: Callable, place: tuple[int, int], otherwise: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make(put("rubiks_cube", *tile_center(place)), task=BRIDGE, objects=1)
    for fallen in (False, True):
        env.reset(seed=0)
        report = PushReport(False, True, np.zeros(1), fallen)
        monkeypatch.setattr(env.scene, "push", lambda _, report=report: report)
        _, reward, terminated, _, info = env.step(NOTHING)
        happened = {name for name in ("success", "violation", "fall") if info[name]}
        assert happened == {"fall" if fallen else otherwise} and terminated
        assert reward == (99 if happened == {"success"} else -101)


def test_the_last_allowed_step_may_still_succeed(make: Make, put: Callable) -> None:
    x, y = tile_center((2, 3))
    env = make(put("rubiks_cube", x, y - 0.03), task=BRIDGE, objects=1, maximum_steps=1)
    env.reset(seed=0)
    push = normalised_push(np.array([x, y + 0.04]), np.array([0.0, -0.1])).astype(np.float32)
    assert env.step(push)[2:4] == (True, False)


# One environment, one world.


def test_the_same_seed_and_actions_give_the_same_episode(make: Make) -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, size=(4, 4)).astype(np.float32)
    one, other = make(objects=4), make(objects=4)
    other.reset(seed=9)  # another past
    other.step(actions[3])
    assert_equal(one.reset(seed=3)[0], other.reset(seed=3)[0])
    for action in actions:  # in turns, so that they could disturb each other
        first, second = one.step(action), other.step(action)
        assert_equal(first[0], second[0])
        assert first[1:] == second[1:]


def test_resets_without_a_seed_go_on_to_new_scenes_in_a_repeatable_order(make: Make) -> None:
    env = make(objects=2)
    runs = []
    for _ in range(2):
        env.reset(seed=3)
        runs.append([env.reset()[0] for _ in range(2)])
    assert_equal(runs[0][0], runs[1][0])
    assert_equal(runs[0][1], runs[1][1])
    assert not np.array_equal(runs[0][0]["centers"], runs[0][1]["centers"])


def test_what_a_caller_does_to_an_observation_changes_no_reward(make: Make) -> None:
    rewards = []
    for spoil in (False, True):
        env = make(objects=2, reward="dense")
        observed, _ = env.reset(seed=0)
        for _ in range(2):
            if spoil:
                for array in observed.values():
                    array += 1
            observed, reward, *_ = env.step(NOTHING)
        rewards.append(reward)
    assert rewards[0] == rewards[1]


# Layouts.


def test_a_layout_may_be_a_number_or_a_file_or_belong_to_a_task_that_has_been_built(make: Make, tmp_path: Path) -> None:
    path = tmp_path / "unseen.yaml"
    path.write_text(yaml.safe_dump(TILES))
    given = ({"task": BRIDGE}, {"layout": path}, {"layout": str(path)}, {"task": Crossing, "layout": path})
    assert [make(**options).task for options in given] == [BRIDGE] * 4
    assert make(task="insertion", layout=2).task == load_task("insertion", 2)
    changed = make(task="insertion", layout=2, tiles={"goal": [[3, 3]]}).task
    assert changed.goal.tiles == ((3, 3),) and changed.region == load_task("insertion", 2).region
    env = make(layout=path, objects=2)
    env.reset(seed=0)
    assert env.step(NOTHING)[1] == -1


# Bad input.


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"objects": 0}, r"^objects must be a whole number from 1 to 10, not 0$"),
        ({"objects": 11}, r"^objects must be a whole number from 1 to 10, not 11$"),
        ({"objects": 2.5}, r"^objects must be a whole number from 1 to 10, not 2.5$"),
        ({"maximum_steps": 0}, r"^maximum_steps must be at least 1, not 0$"),
        ({"render_mode": "human"}, r"^unknown render_mode 'human': choose rgb_array or None$"),
        ({"task": "juggling"}, rf"^unknown task 'juggling': choose from {KNOWN_TASKS}$"),
        ({"reward": "shaped"}, r"^unknown reward 'shaped': choose from dense, sparse$"),
        ({"layout": 3}, r"^unknown layout 3: choose 0, 1, 2, random, generated or the path of a YAML file$"),
        ({"robot": "hand"}, r"^unknown robot 'hand': choose from stick, sawyer, panda$"),
        ({"robot": "sawyer"}, r"^robot sawyer needs a folder with sawyer/sawyer_stick.urdf, and none was given: get"),
        ({"layout": "nowhere.yaml"}, r"^layout nowhere.yaml cannot be read"),
        ({"tiles": {"goal": [[9, 9]]}}, r"goal: tile \[9, 9\] is off the table"),
        ({"tiles": {"bridge": [[1, 1]]}}, r"unknown key 'bridge'"),
        ({"task": BRIDGE, "tiles": {"goal": [[2, 3]]}}, r"^a task object has its own layout"),
    ],
)
def test_a_bad_argument_gets_its_one_line(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        PushingEnv(**options)
    assert "\n" not in str(caught.value)


def test_a_layout_without_room_is_refused_at_reset(make: Make) -> None:
    env = make(task=BRIDGE, objects=5, ranges=ObjectRanges(clearance=0.3))
    with pytest.raises(ValueError, match=r"^no room for 5 objects at least 0.3 m apart where the layout starts"):
        env.reset(seed=0)


def test_an_unknown_object_is_refused_at_reset(make: Make) -> None:
    env = make(ranges=ObjectRanges(names=("spoon",)))
    with pytest.raises(ValueError, match=r"^unknown object 'spoon'"):
        env.reset(seed=0)


@pytest.mark.parametrize("action", [[0.0, 0.0, 0.0, np.nan], [0.0] * 3])
def test_an_action_that_is_not_four_finite_numbers_is_refused(make: Make, action: list) -> None:
    env = make(objects=1)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^an action is four finite numbers"):
        env.step(np.array(action, dtype=np.float32))
    assert env.step(NOTHING)[4]["steps"] == 1  # the refused step did not count


def test_a_step_before_the_first_reset_says_what_to_do(make: Make) -> None:
    with pytest.raises(RuntimeError, match=r"^call reset\(\) before step\(\)$"):
        make().step(NOTHING)


# Pictures.


def test_rendering_gives_a_picture_of_the_table(make: Make) -> None:
    env = make(objects=3, render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image.shape == (424, 512, 3) and image.dtype == np.uint8
    assert image.std() > 10


def test_without_a_render_mode_there_is_no_picture(make: Make) -> None:
    env = make(objects=1)
    env.reset(seed=0)
    assert env.render() is None
