"""Layouts sampled anew at every reset."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
import torch

from envs.layouts import layout_numbers, load_task, possible_tasks
from envs.pushing import PushingEnv
from envs.tasks import TASKS
from envs.tasks.insertion import Insertion
from envs.workspace import REACH_HIGH, REACH_LOW, TILE_COUNT, TILE_SIDE, Tile, tile_center

SLOTS = Insertion.random_layouts()


@pytest.fixture(scope="module")
def envs() -> Iterator[dict[str, PushingEnv]]:
    made = {task: PushingEnv(task=task, layout="random", objects=5) for task in TASKS}
    yield made
    for env in made.values():
        env.close()


def neighbours(tile: Tile) -> set[Tile]:
    i, j = tile
    around = {(i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)}
    return {one for one in around if 0 <= one[0] < TILE_COUNT[0] and 0 <= one[1] < TILE_COUNT[1]}


@pytest.mark.parametrize("slot", SLOTS, ids=lambda slot: str(slot.goal.tiles))
def test_a_slot_is_surrounded_by_the_restricted_area_but_for_its_mouth(slot: Insertion) -> None:
    open_sides = set().union(*(neighbours(tile) for tile in slot.goal)) - {*slot.goal, *slot.region}
    assert len(open_sides) == len(slot.goal)  # each tile of the slot can be entered from one side
    rows, columns = (len({tile[axis] for tile in open_sides}) for axis in (0, 1))
    assert 1 in (rows, columns)  # and all from the same one
    assert not open_sides & {*slot.region, *slot.goal}


@pytest.mark.parametrize("slot", SLOTS, ids=lambda slot: str(slot.goal.tiles))
def test_a_tool_reaches_behind_every_target_and_into_every_slot(slot: Insertion) -> None:
    goal = np.mean([tile_center(tile) for tile in slot.goal], axis=0)
    assert (goal >= np.array(REACH_LOW) - TILE_SIDE / 2).all() and (goal <= np.array(REACH_HIGH)).all()
    inward = np.mean([tile_center(tile) for tile in slot.region], axis=0) - (0.595, -0.035)
    along = inward / np.abs(inward).max()
    for tile in slot.target_start:
        behind = np.array(tile_center(tile)) - 0.08 * np.round(along)
        assert (behind >= REACH_LOW).all() and (behind <= REACH_HIGH).all()


def test_fixed_layouts_are_among_the_slots() -> None:
    assert len({(slot.goal, slot.region) for slot in SLOTS}) == len(SLOTS) == 10
    fixed = load_task("insertion", 0)
    assert any(
        all(set(getattr(slot, name)) == set(getattr(fixed, name)) for name in fixed.layout_keys()) for slot in SLOTS
    )
    assert load_task("insertion", 2).goal in [slot.goal for slot in SLOTS]


@pytest.mark.parametrize("task", ["clearing", "crossing"])
def test_other_tasks_sample_one_of_the_fixed_layouts(task: str) -> None:
    assert possible_tasks(task, "random") == tuple(load_task(task, number) for number in layout_numbers(task))


def test_a_layout_of_a_number_is_that_one_alone() -> None:
    assert possible_tasks("crossing", 1, {"goal": None}) == (load_task("crossing", 1),)


def test_tiles_that_replace_those_of_a_random_layout_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^tiles replace fields of one layout: give layout=0, 1, 2 or a YAML file"):
        possible_tasks("insertion", "random", {"goal": [[2, 1]]})
    possible_tasks("insertion", "random", {"goal": None})


def test_other_fields_are_those_of_every_random_layout() -> None:
    options = {"clearance": 0.2, "places": []}
    assert possible_tasks("rearrange", "random", options) == (load_task("rearrange", 0, options),)


@pytest.mark.parametrize("task", TASKS)
def test_every_layout_that_may_be_sampled_has_room_for_five_objects(task: str, envs: dict[str, PushingEnv]) -> None:
    env = envs[task]
    for number, task_in_layout in enumerate(env.tasks):
        observed, info = env.reset(seed=number, options={"layout": number})
        assert info["task"] == env.task == env.reward.task
        assert info["task"].tile_groups() == task_in_layout.tile_groups()
        assert info["task"] == task_in_layout or task_in_layout.goal_varies
        assert observed["mask"].all()


def test_a_layout_that_does_not_exist_cannot_be_reset_to(envs: dict[str, PushingEnv]) -> None:
    with pytest.raises(ValueError, match=r"^no layout 10 to reset to: choose from 0 to 9$"):
        envs["insertion"].reset(options={"layout": 10})


def test_every_reset_samples_a_layout_determined_by_the_seed() -> None:
    sampled = []
    for _ in range(2):
        env = gymnasium.make("cavin/Insertion-v0", layout="random", objects=1)
        sampled.append([env.reset(seed=1 if number == 0 else None)[1]["task"] for number in range(40)])
        env.close()
    assert sampled[0] == sampled[1]
    times = Counter(sampled[0])
    assert len(times) >= 8 and max(times.values()) <= 12  # of ten that are equally likely


def test_the_reward_is_that_of_the_sampled_layout(envs: dict[str, PushingEnv]) -> None:
    env = envs["insertion"]
    for number, other in ((1, 4), (4, 1)):  # slots at opposite ends of the table
        env.reset(seed=0, options={"layout": number})
        middle = torch.tensor([[0.595, -0.035, 0.03]])
        for slot, reached in ((number, True), (other, False)):
            there = torch.tensor([[*tile_center(env.tasks[slot].goal.tiles[0]), 0.03]])
            assert bool(env.reward(middle, there, torch.tensor([True])).success) == reached


def test_a_scene_is_the_same_whether_its_layout_was_sampled_or_asked_for(envs: dict[str, PushingEnv]) -> None:
    env = envs["clearing"]
    for seed in range(3):
        sampled, info = env.reset(seed=seed)
        number = env.tasks.index(info["task"])
        asked = PushingEnv(task="clearing", layout=number, objects=5)
        np.testing.assert_array_equal(asked.reset(seed=seed)[0]["clouds"], sampled["clouds"])
        asked.close()
