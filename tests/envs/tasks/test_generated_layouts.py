"""Generated layouts: what was wanted, on the table, within the tool's reach, and the same for the same seed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.layouts import generate_task
from envs.pushing import PushingEnv
from envs.tasks import GeneratedLayouts, Task
from envs.tasks.clearing import Clearing
from envs.tasks.crossing import Crossing
from envs.tasks.generated import FEWEST, MOST, SHAPES, blocks, neighbours, paths, reachable_tiles, starting_tiles
from envs.tasks.insertion import Insertion
from envs.workspace import REACH_HIGH, REACH_LOW, Tile, normalised_push, tile_center

SEEDS = st.integers(0, 2**32 - 1)
TURNS = {"straight": [0], "l": [1], "u": [2], "s": [2], "winding": range(3, 13)}


def generated(task: str, seed: int, **wanted: Any) -> Any:
    return generate_task(task, GeneratedLayouts(**wanted), np.random.default_rng(seed))


def walk(tiles: set[Tile], start: Tile) -> list[Tile]:
    """The tiles in the order in which one comes to them from `start`, as far as they are connected."""
    seen = [start]
    for tile in seen:
        seen += [other for other in neighbours(tile) if other in tiles and other not in seen]
    return seen


def in_reach(tile: Tile) -> bool:
    x, y = tile_center(tile)
    return REACH_LOW[0] < x < REACH_HIGH[0] and REACH_LOW[1] < y < REACH_HIGH[1]


def turns(path: list[Tile]) -> int:
    steps = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(path)]
    return sum(a != b for a, b in pairwise(steps))


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(FEWEST, MOST), st.sampled_from(["any", "u", "winding"]))
def test_a_bridge_is_one_path_of_that_length_from_start_to_goal(seed: int, tiles: int, shape: str) -> None:
    if shape not in ("any", *paths(tiles)):
        shape = "any"
    bridge: Crossing = generated("crossing", seed, tiles=tiles, shape=shape)
    region = set(bridge.region)
    (start,), (goal,) = bridge.target_start, bridge.goal
    assert len(region) == len(bridge.region) == tiles and start != goal and {start, goal} <= region
    assert start in starting_tiles()
    path = walk(region, start)
    assert len(path) == tiles and path[-1] == goal  # connected, and the goal is the farthest
    assert all(len(set(neighbours(tile)) & region) == 2 for tile in region - {start, goal})  # without shortcuts
    assert len(set(neighbours(start)) & region) == len(set(neighbours(goal)) & region) == 1
    assert all(in_reach(tile) for tile in region)
    assert shape == "any" or turns(path) in TURNS[shape]
    assert set(bridge.obstacle_start) == set(reachable_tiles())


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(FEWEST, MOST))
def test_a_region_to_clear_is_connected_and_all_objects_start_in_it(seed: int, tiles: int) -> None:
    task: Clearing = generated("clearing", seed, tiles=tiles)
    region = set(task.region)
    assert len(region) == tiles and set(walk(region, min(region))) == region
    assert set(task.target_start) == set(task.obstacle_start) == region
    assert all(in_reach(tile) for tile in region)


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(4, 8))
def test_a_slot_is_as_far_away_as_wanted(seed: int, tiles: int) -> None:
    task: Insertion = generated("insertion", seed, tiles=tiles)
    (start,) = task.target_start
    free = {(i, j) for i in range(5) for j in range(7)} - set(task.region)
    rounds, reached = 1, set(task.goal)
    while start not in reached:
        reached |= {other for tile in reached for other in neighbours(tile) if other in free}
        rounds += 1
    assert rounds == tiles and start in starting_tiles()
    assert any(slot.goal == task.goal and slot.region == task.region for slot in Insertion.random_layouts())
    assert not set(task.obstacle_start) & {*task.region, *task.goal} and len(task.obstacle_start) >= 5


def test_beyond_a_tile_where_the_target_starts_there_is_room_for_it_and_the_tool() -> None:
    corners = np.array([tile_center(tile) for tile in starting_tiles()])
    beyond = np.minimum(corners - REACH_LOW, np.array(REACH_HIGH) - corners)
    assert beyond.min() >= 0.12  # metres: 0.05 from the tile's centre, half an object of 0.1, and the tool
    assert len({tuple(tile) for tile in starting_tiles()}) == 12 and (3, 3) not in starting_tiles()


def test_the_tool_gets_behind_the_target_where_it_starts() -> None:
    env = PushingEnv(task="crossing", layout="generated", generated=GeneratedLayouts(tiles=6), objects=1)
    pushed = []
    for seed in range(8, 13):  # with starts on any tile, four of these twenty pushes would have no room
        for direction in np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)]):
            before = env.reset(seed=seed)[0]["centers"][0, :2]
            start = np.clip(before - 0.1 * direction, REACH_LOW, REACH_HIGH)
            after, *_ = env.step(normalised_push(start, 0.1 * direction).astype(np.float32))
            pushed.append((after["centers"][0, :2] - before) @ direction > 0.01)
    env.close()
    assert sum(pushed) >= 19  # of 20


@pytest.mark.soak
def test_slots_are_on_every_side_that_the_tool_reaches() -> None:
    goals = {goal for seed in range(200) for goal in generated("insertion", seed, tiles=5).goal}
    assert {row for row, column in goals if column == 1} >= {1, 2, 3}  # the right end
    assert {row for row, column in goals if column == 5} >= {1, 2, 3}  # the left end
    assert {column for row, column in goals if row == 3} >= {2, 3, 4}  # the far side


@pytest.mark.parametrize("tiles", [5, 8])
def test_every_shape_there_is_is_as_likely_as_the_others(tiles: int) -> None:
    paths_of = {shape: set(map(frozenset, found)) for shape, found in paths(tiles).items()}
    counts = dict.fromkeys(paths_of, 0)
    for seed in range(300):
        region = frozenset(generated("crossing", seed, tiles=tiles).region)
        for shape, found in paths_of.items():
            counts[shape] += region in found
    assert min(counts.values()) > 0.6 * 300 / len(counts)


def test_paths_go_both_ways_and_shapes_are_told_apart() -> None:
    for shape, found in paths(6).items():
        assert {path[::-1] for path in found} == set(found)
        assert {turns(list(path)) for path in found} <= set(TURNS[shape])
    assert set(paths(6)) == {"straight", "l", "u", "s", "winding"} and set(paths(14)) == {"u", "winding"}
    u, s = paths(6)["u"][0], paths(6)["s"][0]
    for path, back in ((u, True), (s, False)):  # a U ends in the direction opposite to that in which it begins
        first, last = ((b[0] - a[0], b[1] - a[1]) for a, b in (path[:2], path[-2:]))
        assert (first == (-last[0], -last[1])) == back and (first == last) != back
    assert all(len(set(block)) == 6 for block in blocks(6)) and not blocks(7)


def test_obstacles_can_be_kept_off_the_bridge() -> None:
    for seed in range(20):
        bridge: Crossing = generated("crossing", seed, tiles=MOST, obstacles="beside")
        assert not set(bridge.obstacle_start) & set(bridge.region) and len(bridge.obstacle_start) >= 5


@pytest.mark.parametrize("task", ["crossing", "clearing", "insertion"])
def test_the_layout_follows_the_seed(task: str) -> None:
    layouts = [generated(task, seed, tiles=5) for seed in (*range(8), *range(8))]
    assert layouts[:8] == layouts[8:] and len(set(layouts)) > 4
    fixed = GeneratedLayouts(tiles=6, seed=5)
    assert len({generate_task(task, fixed, np.random.default_rng(seed)) for seed in range(4)}) == 1


@pytest.mark.parametrize(("task", "tiles"), [("crossing", MOST), ("clearing", FEWEST), ("insertion", 7)])
def test_every_scene_has_its_own_layout_with_room_for_five_objects(task: str, tiles: int) -> None:
    env = PushingEnv(task=task, layout="generated", generated=GeneratedLayouts(tiles=tiles), objects=5)
    seen: dict[int, Task] = {}
    for seed in (1, 2, 3, 1):
        observed, info = env.reset(seed=seed)
        assert observed["mask"].all() and info["task"] is env.task is env.reward.task
        assert seen.setdefault(seed, env.task) == env.task
    assert env.reset()[1]["task"] != seen[1]  # the next scene of the same run
    env.close()
    assert len(set(seen.values())) > 1


@pytest.mark.parametrize(
    ("task", "wanted", "problem"),
    [
        ("crossing", {"tiles": 3}, r"^generated\.tiles must be a whole number from 4 to 14, not 3$"),
        ("crossing", {"shape": "round"}, r"^unknown generated\.shape 'round': choose from straight, l, u, s, winding"),
        ("crossing", {"obstacles": "no"}, r"^unknown generated\.obstacles 'no': choose anywhere or beside$"),
        ("crossing", {"seed": -1}, r"^generated\.seed must be at least 0 or null, not -1$"),
        ("crossing", {"tiles": 8, "shape": "straight"}, r"^no bridge of 8 tiles .* choose generated\.shape=l, u, s, w"),
        ("crossing", {"shape": "block"}, r"^no bridge of 6 tiles is generated with shape=block: choose"),
        ("clearing", {"tiles": 7, "shape": "block"}, r"^no region of 7 tiles is generated with shape=block: choose"),
        ("insertion", {"tiles": 9}, r"^ways to a slot have 4 to 8 tiles and any shape: choose generated\.tiles=4 to 8"),
        ("insertion", {"shape": "u"}, r"^ways to a slot have 4 to 8 tiles and any shape"),
        ("gathering", {}, r"^task gathering has no generated layouts: give another layout, or another task$"),
    ],
)
def test_what_cannot_be_generated_is_refused_in_one_line(task: str, wanted: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        PushingEnv(task=task, layout="generated", generated=GeneratedLayouts(**wanted))


def test_tiles_that_replace_those_of_a_generated_layout_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^tiles replace fields of one layout: .*, not generated$"):
        PushingEnv(task="crossing", layout="generated", tiles={"goal": [[1, 2]]})


@dataclass(frozen=True, kw_only=True)
class Careful(Crossing):
    """Crossing with an option."""

    distance: float = 0.1


def test_other_fields_are_those_of_every_generated_layout() -> None:
    generator = np.random.default_rng(3)
    found = generate_task(Careful, GeneratedLayouts(), generator, {"distance": 0.3})
    assert isinstance(found, Careful) and found.distance == 0.3


def test_every_shape_that_is_named_exists() -> None:
    assert {*paths(6), "block"} == set(SHAPES)
