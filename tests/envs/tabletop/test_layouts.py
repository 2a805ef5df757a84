"""Layouts: the paper's nine, random and generated ones, and tasks of a user's own."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cavin_pyro.envs.tabletop.layouts import generate_task, layout_numbers, load_task, parse_task, possible_tasks
from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.envs.tabletop.tasks import TASKS, GeneratedLayouts, Step, Task, TaskReward, TileSet
from cavin_pyro.envs.tabletop.tasks.crossing import Crossing
from cavin_pyro.envs.tabletop.tasks.generated import FEWEST, MOST, neighbours, paths, reachable_tiles, starting_tiles
from cavin_pyro.envs.tabletop.tasks.insertion import Insertion
from cavin_pyro.envs.tabletop.tasks.reach import check_reach
from cavin_pyro.envs.tabletop.workspace import Tile

# SHA-256 of the nine layouts of the published implementation, as listed in the paper's appendix.
PUBLISHED = "0c9a8b56df28751c"
CROSSING = {
    "region": [[2, 2], [2, 3], [2, 4]],
    "goal": [[2, 2]],
    "target_start": [[2, 4]],
    "obstacle_start": [[1, 3], [3, 3]],
}


def write(folder: Path, content: Any) -> Path:
    path = folder / "mine.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def test_the_builtin_layouts_are_the_published_ones() -> None:
    tiles = []
    for name, number in product(("clearing", "insertion", "crossing"), range(3)):
        task = load_task(name, number)
        tiles.append((name, number, {field: sorted(getattr(task, field)) for field in task.layout_keys()}))
    assert hashlib.sha256(json.dumps(tiles).encode()).hexdigest()[:16] == PUBLISHED


@pytest.mark.parametrize("kind", [str, Path])
def test_a_layout_is_read_from_a_file(tmp_path: Path, kind: type) -> None:
    layout = load_task("crossing", kind(write(tmp_path, {"task": "crossing", **CROSSING})))
    assert layout == Crossing(**CROSSING)
    assert layout == load_task("crossing", write(tmp_path, CROSSING))  # the file need not name its task


@pytest.mark.parametrize(
    ("task", "change", "message"),
    [
        ("crossing", {"region": [[2, 2], [2, 3], [5, 3]]}, r"region: tile \[5, 3\] is off the table"),
        ("crossing", {"goal": [[2.0, 2]]}, r"goal: a tile is two whole numbers such as \[2, 3\], not \[2.0, 2\]"),
        ("crossing", {"bridge": [[2, 2]]}, r"unknown key 'bridge', valid keys are task, region, goal, target_start"),
        ("crossing", {"goal": [[2, 4]]}, r"tile \[2, 4\] is both goal and target_start"),
        ("insertion", {"region": [[1, 3]]}, r"obstacle_start tile \[1, 3\] overlaps the restricted region"),
        ("clearing", {"task": "crossing"}, r"is for task crossing: run it with task=crossing$"),
        ("crossing", {"task": "juggling"}, r"unknown task 'juggling', choose from clearing, crossing, "),
    ],
)
def test_a_layout_that_makes_no_sense_gets_its_one_line(tmp_path: Path, task: str, change: dict, message: str) -> None:
    path = write(tmp_path, CROSSING | change)
    with pytest.raises(ValueError, match=message) as caught:
        load_task(task, path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_no_layout_get_one_line(tmp_path: Path) -> None:
    path = write(tmp_path, {name: tiles for name, tiles in CROSSING.items() if name != "goal"})
    with pytest.raises(ValueError, match=r"mine\.yaml: the key 'goal' is missing$"):
        load_task("crossing", path)
    for text in ("region: [[1, 2]", "a: !!python/none", "#" * 100_001):
        with pytest.raises(ValueError, match=r"mine\.yaml is not YAML: ") as caught:
            load_task("crossing", write(tmp_path, text))
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"mine\.yaml has the key 'a' twice"):
        load_task("crossing", write(tmp_path, "a: []\na: [[1, 2]]"))
    for layout in ("nowhere.yaml", -1, tmp_path):
        with pytest.raises(ValueError, match=r"cannot be read \(.*\): give 0, 1, 2, hard, random, generated or"):
            load_task("crossing", layout)
    with pytest.raises(ValueError, match=r"crossing_0\.yaml with overrides: goal tile \[4, 6\] is off the bridge, add"):
        load_task("crossing", 0, {"goal": [[4, 6]]})
    with pytest.raises(ValueError, match=r"^tiles replace fields of one layout: give layout=0, 1, 2 or a YAML file"):
        possible_tasks("insertion", "random", {"goal": [[2, 1]]})


SLOTS = Insertion.random_layouts()


@pytest.fixture(scope="module")
def envs() -> Iterator[dict[str, PushingEnv]]:
    made = {task: PushingEnv(task=task, layout="random", objects=5) for task in TASKS}
    yield made
    for env in made.values():
        env.close()


@pytest.mark.parametrize("slot", SLOTS, ids=lambda slot: str(slot.goal.tiles))
def test_a_slot_is_surrounded_by_the_restricted_area_but_for_its_mouth(slot: Insertion) -> None:
    beside = {one for tile in slot.goal for one in neighbours(tile) if 0 <= one[0] < 5 and 0 <= one[1] < 7}
    open_sides = beside - {*slot.goal, *slot.region}
    assert len(open_sides) == len(slot.goal)  # each tile of the slot can be entered from one side
    rows, columns = (len({tile[axis] for tile in open_sides}) for axis in (0, 1))
    assert 1 in (rows, columns)  # and all from the same one


@pytest.mark.parametrize("task", TASKS)
def test_every_layout_that_may_be_sampled_has_room_for_five_objects(task: str, envs: dict[str, PushingEnv]) -> None:
    env = envs[task]
    for number, task_in_layout in enumerate(env.tasks[::3]):
        number *= 3
        observed, info = env.reset(seed=number, options={"layout": number})
        assert info["task"] == env.task == env.reward.task
        assert info["task"].tile_groups() == task_in_layout.tile_groups()
        assert info["task"] == task_in_layout or task == "rearrange"
        assert observed["mask"].all()


def test_every_reset_samples_a_layout_determined_by_the_seed(envs: dict[str, PushingEnv]) -> None:
    env = envs["insertion"]
    first, again = ([env.reset(seed=1 if number == 0 else None)[1]["task"] for number in range(8)] for _ in range(2))
    assert first == again and len(set(first)) >= 3  # of ten that are equally likely


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


def turns(path: list[Tile]) -> int:
    steps = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(path)]
    return sum(a != b for a, b in pairwise(steps))


@settings(max_examples=30, deadline=None)
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
    assert region <= set(reachable_tiles())
    assert shape == "any" or turns(path) in TURNS[shape]
    assert set(bridge.obstacle_start) == set(reachable_tiles())


@settings(max_examples=20, deadline=None)
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


@pytest.mark.parametrize(("task", "tiles"), [("crossing", MOST), ("clearing", FEWEST), ("insertion", 7)])
def test_every_scene_has_its_own_layout_with_room_for_five_objects(task: str, tiles: int) -> None:
    env = PushingEnv(task=task, layout="generated", generated=GeneratedLayouts(tiles=tiles), objects=5)
    seen: dict[int, Task] = {}
    for seed in (1, 3, 1):
        observed, info = env.reset(seed=seed)
        assert observed["mask"].all() and info["task"] is env.task is env.reward.task
        assert seen.setdefault(seed, env.task) == env.task
    env.close()
    assert len(set(seen.values())) > 1


@pytest.mark.parametrize(
    ("task", "wanted", "problem"),
    [
        ("crossing", {"tiles": 3}, r"^generated\.tiles must be a whole number of at least 4 and at most 14, not 3$"),
        ("crossing", {"tiles": 8, "shape": "straight"}, r"^no bridge of 8 tiles .* choose generated\.shape=l, u, s, w"),
        ("insertion", {"tiles": 9}, r"^ways to a slot have 4 to 8 tiles and any shape: choose generated\.tiles=4 to 8"),
        ("rearrange", {}, r"^task rearrange has no generated layouts: give another layout, or another task$"),
    ],
)
def test_what_cannot_be_generated_is_refused_in_one_line(task: str, wanted: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        PushingEnv(task=task, layout="generated", generated=GeneratedLayouts(**wanted))


U = [[0, 1], [1, 1], [2, 1], [2, 2], [2, 3], [1, 3], [0, 3]]
FAR = [[3, 1], [4, 1], [4, 2], [4, 3], [3, 3]]


@pytest.mark.parametrize(
    ("region", "start", "goal", "stuck"),
    [
        (U, [0, 1], [0, 3], [0, 1]),  # no tool fits between the robot and the start
        (FAR, [3, 1], [3, 3], [4, 3]),  # nor beyond the far row, to bring the target back
        (U, [1, 1], [0, 3], None),
        (U[:2] + U[-2:], [0, 1], [0, 3], []),  # apart
        ([[0, 1], [0, 2], [0, 3]], [0, 1], [0, 3], None),  # sideways
        (FAR[:2], [3, 1], [4, 1], None),
    ],
)
def test_a_start_from_which_the_tool_cannot_push_to_the_goal_is_refused(
    region: list, start: list, goal: list, stuck: list | None, tmp_path: Path
) -> None:
    tiles = {"region": region, "target_start": [start], "goal": [goal], "obstacle_start": [[2, 5]]}
    path = write(tmp_path, tiles)
    if stuck is None:
        assert load_task("crossing", path) == Crossing(**tiles)
        return
    with pytest.raises(ValueError) as caught:
        load_task("crossing", path)
    said = str(caught.value)
    why = f"no push leads on from tile {stuck}" if stuck else "no way leads"
    assert said.startswith(f"layout {path}: target_start tile {start}: {why} to the goal")
    assert "\n" not in said


def test_pushes_solve_every_shipped_random_and_generated_layout() -> None:
    shipped = [load_task(task, number) for task in TASKS for number in layout_numbers(task)]
    shipped += [load_task(task, "hard") for task in ("clearing", "insertion", "crossing")]
    for one in (*shipped, *SLOTS):
        check_reach(one)
    for task, tiles, seed in product(("crossing", "clearing", "insertion"), (4, 6, 8), range(5)):
        check_reach(generated(task, seed, tiles=tiles))


STARTS = {"target_start": [[1, 3]], "obstacle_start": [[1, 5]]}


@dataclass(frozen=True, kw_only=True)
class Visit(Task):
    """Bring the target to a number of the places, and be paid for staying away from others."""

    maximum_return = math.inf

    places: TileSet
    shunned: TileSet = field(default_factory=lambda: TileSet([]))
    bonus: float = 0.5

    def success(self, step: Step) -> Tensor:
        return self.places.contains(step.target)

    def potential(self, positions: Tensor, mask: Tensor) -> Tensor:
        return -self.places.distance_to_nearest_center(positions[..., 0, :])

    def terms(self, step: Step, success: Tensor, failure: Tensor, *, dense: bool) -> dict[str, Tensor]:
        away = self.bonus * ~self.shunned.contains(step.target) if self.shunned else torch.zeros(success.shape)
        return {**super().terms(step, success, failure, dense=dense), "away": away}


def test_fields_with_defaults_may_be_left_out_of_a_layout_and_options_may_be_in_it() -> None:
    plain = parse_task(Visit, {"places": [[0, 0]], **STARTS})
    assert plain == Visit(places=[(0, 0)], target_start=[(1, 3)], obstacle_start=TileSet([(1, 5)]))
    assert (plain.shunned.tiles, plain.bonus, plain.name) == ((), 0.5, "visit")
    assert parse_task(Visit, {"places": [[0, 0]], "bonus": 2.0, **STARTS}).bonus == 2.0


def test_a_reward_is_the_sum_of_its_named_terms(tmp_path: Path) -> None:
    path = write(tmp_path, {"places": [[0, 0]], "shunned": [[4, 6]], **STARTS})
    env = PushingEnv(task=Visit, layout=path, tiles={"bonus": 0.25}, objects=2)
    env.reset(seed=0)
    _, reward, *_, info = env.step(np.zeros(4, np.float32))
    assert info["terms"] == {"goal": 0, "violation": 0, "time": -1, "progress": 0, "away": 0.25}
    assert reward == -0.75
    assert TaskReward(env.task).maximum_return == math.inf
    env.close()


def test_what_is_no_whole_task_is_refused() -> None:
    class Half(Task):
        def success(self, step: Step) -> Tensor:
            return step.mask[..., 0]

    class Plain(Visit):
        wanted: int = 2

    decorate = r"^decorate Plain with @dataclass\(frozen=True, kw_only=True\)$"
    for kind, said in ((Half, r"^task Half lacks potential$"), (Plain, decorate)):
        with pytest.raises(ValueError, match=said):
            load_task(kind)


@pytest.mark.parametrize(
    ("function", "change", "message"),
    [
        ("success", Tensor.float, r"success must return bool \[\.\.\.\], here \[8, 6\], not torch.float32 \[8, 6\]"),
        ("success", lambda right: right[:, 0], r"success must return bool .*, not torch.bool \[8\]"),
        ("potential", lambda right: right.sum(-1, keepdim=True), r"potential must return metres .*\[8, 1\]"),
    ],
)
def test_functions_of_a_users_task_are_checked_when_an_environment_is_built(
    function: str, change: Callable[[Tensor], object], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = getattr(Visit, function)
    monkeypatch.setattr(Visit, function, lambda self, *arguments: change(right(self, *arguments)))
    with pytest.raises(ValueError, match=f"^task Visit: {message}"):
        PushingEnv(task=Visit(places=[(0, 0)], **STARTS), objects=3)
