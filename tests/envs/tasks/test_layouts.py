"""Layouts: the paper's nine, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from envs.layouts import layout_numbers, load_task, parse_task
from envs.tasks import TASKS
from envs.tasks.crossing import Crossing

SLOT_AT_THE_SIDE = [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (3, 0), (3, 1), (4, 0), (4, 1)]
SLOT_AT_THE_FRONT = [(3, 1), (3, 2), (3, 5), (3, 6), *((4, j) for j in range(1, 7))]
BRIDGES = (
    [(0, 0), (0, 2), (0, 5), (1, 0), (1, 1), (1, 2), (1, 5), (2, 2), (2, 3), (2, 4), (2, 5), (3, 2)],
    [
        *((0, 0), (0, 1), (0, 2), (0, 5), (1, 0), (1, 2), (1, 3)),
        *((1, 4), (1, 5), (2, 0), (2, 2), (2, 5), (3, 2), (3, 5)),
    ],
    [
        *((0, 2), (0, 5), (1, 2), (1, 5), (1, 6), (2, 1), (2, 2)),
        *((2, 3), (2, 4), (2, 5), (3, 1), (3, 2), (3, 5)),
    ],
)


def block(rows: range, columns: range) -> list[tuple[int, int]]:
    return list(product(rows, columns))


CLEAR_2 = [*block(range(2), range(2, 6)), (2, 3), (2, 4)]
MIDDLE = block(range(1, 4), range(1, 7))

# As in the published implementation: region, goal, where the target starts, where obstacles start.
PUBLISHED = {
    ("clearing", 0): (block(range(3), range(2, 6)), [], *[block(range(1, 3), range(3, 5))] * 2),
    ("clearing", 1): (*[block(range(1, 3), range(2, 6)), []], *[block(range(1, 3), range(2, 6))] * 2),
    ("clearing", 2): (CLEAR_2, [], CLEAR_2, CLEAR_2),
    ("insertion", 0): (SLOT_AT_THE_SIDE, [(2, 1)], [(2, 3), (2, 4)], block(range(1, 4), range(3, 5))),
    ("insertion", 1): (SLOT_AT_THE_SIDE, [(2, 1)], [(2, 3), (2, 4)], block(range(1, 4), range(3, 5))),
    ("insertion", 2): (
        *(SLOT_AT_THE_FRONT, [(3, 3), (3, 4)]),
        *(block(range(1, 2), range(2, 6)), block(range(1, 3), range(2, 6))),
    ),
    ("crossing", 0): (BRIDGES[0], [(1, 2)], [(2, 5)], MIDDLE),
    ("crossing", 1): (BRIDGES[1], [(3, 2)], [(1, 4), (1, 5)], MIDDLE),
    ("crossing", 2): (BRIDGES[2], [(1, 6)], [(1, 2), (2, 1), (2, 2)], MIDDLE),
}
CROSSING = {
    "region": [[2, 2], [2, 3], [2, 4]],
    "goal": [[2, 2]],
    "target_start": [[2, 4]],
    "obstacle_start": [[1, 3], [3, 3]],
}


KNOWN_TASKS = ", ".join(TASKS)
WITHOUT = object()  # a key that is left out


def write(folder: Path, content: Any) -> Path:
    path = folder / "mine.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


@pytest.mark.parametrize(("task", "number"), PUBLISHED)
def test_the_builtin_layouts_are_the_published_ones(task: str, number: int) -> None:
    layout = load_task(task, number)
    found = [layout.region, getattr(layout, "goal", []), layout.target_start, layout.obstacle_start]
    assert layout.name == task
    assert [sorted(tiles) for tiles in found] == [sorted(tiles) for tiles in PUBLISHED[task, number]]


def test_all_nine_are_builtin() -> None:
    assert {(task, number) for task in TASKS for number in layout_numbers(task)} >= set(PUBLISHED)


@pytest.mark.parametrize("number", ["2", np.int64(2), 2])
def test_a_builtin_layout_may_be_named_by_any_kind_of_number(number: Any) -> None:
    assert load_task("crossing", number) == load_task("crossing", 2)


@pytest.mark.parametrize("kind", [str, Path])
def test_a_layout_is_read_from_a_file(tmp_path: Path, kind: type) -> None:
    layout = load_task("crossing", kind(write(tmp_path, {"task": "crossing", **CROSSING})))
    assert layout == Crossing(**CROSSING)
    assert layout == load_task("crossing", write(tmp_path, CROSSING))  # the file need not name its task


def test_a_task_has_its_own_fields_and_no_others() -> None:
    tiles = {"region": [[1, 1]], "target_start": [[1, 1]], "obstacle_start": [[1, 1]]}
    assert parse_task("clearing", tiles).layout_keys() == dict.fromkeys(tiles, True)
    assert list(TASKS["insertion"].layout_keys()) == ["region", "goal", "target_start", "obstacle_start"]


def test_overrides_replace_the_fields_that_they_name() -> None:
    plain = load_task("insertion", 0)
    changed = load_task("insertion", 0, {"target_start": [[2, 5]], "goal": None, "region": None})
    assert changed.target_start.tiles == ((2, 5),)
    assert changed == replace(plain, target_start=[(2, 5)])


@pytest.mark.parametrize(
    ("task", "change", "message"),
    [
        ("crossing", {"region": [[2, 2], [2, 3], [5, 3]]}, r"region: tile \[5, 3\] is off the table"),
        ("crossing", {"region": [[2, 2], [2, 3], [2, 7]]}, r"which holds \[0, 0\] to \[4, 6\]$"),
        ("crossing", {"obstacle_start": [[-1, 3]]}, r"obstacle_start: tile \[-1, 3\] is off the table"),
        ("crossing", {"obstacle_start": [[10**400, 3]]}, r"is off the table"),
        ("crossing", {"region": [[2, 2], [2, 4], [2, 2]]}, r"region: tile \[2, 2\] is listed twice"),
        (
            "crossing",
            {"goal": [[2.0, 2]]},
            r"goal: a tile is two whole numbers such as \[2, 3\], not \[2.0, 2\]",
        ),
        ("crossing", {"goal": [["2", 2]]}, r"goal: a tile is two whole numbers"),
        ("crossing", {"goal": [[True, 2]]}, r"goal: a tile is two whole numbers"),
        ("crossing", {"goal": [[2, 2, 2]]}, r"goal: a tile is two whole numbers"),
        ("crossing", {"goal": [2, 2]}, r"goal: a tile is two whole numbers .* not 2$"),
        ("crossing", {"goal": 3}, r"goal must be a list of tiles such as .*, not 3$"),
        ("crossing", {"goal": {"a": 1}}, r"goal must be a list of tiles"),
        ("crossing", {"region": None}, r"region must be a list of tiles such as .*, not None$"),
        (
            "crossing",
            {"bridge": [[2, 2]]},
            r"unknown key 'bridge', valid keys are task, region, goal, target_start",
        ),
        ("crossing", {7: [[2, 2]], "bridge": []}, r"unknown key 7, valid keys are"),
        ("crossing", {"region": []}, r"region needs at least one tile"),
        ("crossing", {"obstacle_start": []}, r"obstacle_start needs at least one tile"),
        ("crossing", {"goal": []}, r"goal needs at least one tile"),
        ("crossing", {"goal": [[2, 4]]}, r"tile \[2, 4\] is both goal and target_start"),
        ("crossing", {"goal": [[3, 2]]}, r"goal tile \[3, 2\] is off the bridge, add it to region"),
        ("crossing", {"target_start": [[2, 5]]}, r"target_start tile \[2, 5\] is off the bridge, add it to region"),
        ("insertion", {"region": [[2, 2], [2, 1]]}, r"goal tile \[2, 2\] overlaps the restricted region"),
        ("insertion", {"region": [[2, 4]]}, r"target_start tile \[2, 4\] overlaps the restricted region"),
        ("insertion", {"region": [[1, 3]]}, r"obstacle_start tile \[1, 3\] overlaps the restricted region"),
        ("insertion", {"region": [[0, 0]], "goal": []}, r"goal needs at least one tile"),
        ("clearing", {}, r"unknown key 'goal', valid keys are task, region, target_start, obstacle_start$"),
        (
            "clearing",
            {"goal": WITHOUT, "target_start": [[0, 0]]},
            r"target_start tile \[0, 0\] is outside the region",
        ),
        ("clearing", {"task": "crossing"}, r"is for task crossing: run it with task=crossing$"),
        (
            "crossing",
            {"task": "juggling"},
            rf"unknown task 'juggling', choose from {KNOWN_TASKS}$",
        ),
        ("crossing", {"task": ["crossing"]}, r"unknown task \['crossing'\], choose from"),
    ],
)
def test_a_layout_that_makes_no_sense_gets_its_one_line(tmp_path: Path, task: str, change: dict, message: str) -> None:
    path = write(tmp_path, {name: tiles for name, tiles in (CROSSING | change).items() if tiles is not WITHOUT})
    with pytest.raises(ValueError, match=message) as caught:
        load_task(task, path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["region", "goal", "target_start", "obstacle_start"])
def test_a_missing_key_is_named(tmp_path: Path, key: str) -> None:
    path = write(tmp_path, {name: tiles for name, tiles in CROSSING.items() if name != key})
    with pytest.raises(ValueError, match=rf"mine\.yaml: the key '{key}' is missing$"):
        load_task("crossing", path)


@pytest.mark.parametrize(
    "text", ["region: [[1, 2]", "\x00", "a: b: c", "- [\n - {", "a: !!python/none", "a: 2024-99-99"]
)
def test_what_is_not_yaml_gets_one_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(ValueError, match=r"mine\.yaml is not YAML: ") as caught:
        load_task("crossing", write(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_bytes_that_are_no_text_get_one_line(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_bytes(b"\xff\xfe\x80")
    with pytest.raises(ValueError, match=r"mine\.yaml is not YAML: "):
        load_task("crossing", tmp_path / "mine.yaml")


@pytest.mark.parametrize("text", ["", "3", "[[1, 2]]", "crossing"])
def test_the_error_of_a_file_without_keys_lists_them(tmp_path: Path, text: str) -> None:
    with pytest.raises(ValueError, match=r"mine\.yaml must hold the keys region, goal, target_start"):
        load_task("crossing", write(tmp_path, text))


@pytest.mark.parametrize("layout", ["nowhere.yaml", -1, 1.0, None, "", "²"])
def test_the_error_of_a_layout_that_is_no_file_lists_the_choices(tmp_path: Path, layout: Any) -> None:
    with pytest.raises(
        ValueError, match=r"cannot be read \(.*\): give 0, 1, 2, random, generated or the path of a YAML file$"
    ):
        load_task("crossing", layout)
    with pytest.raises(ValueError, match=r"cannot be read \(Is a directory\)"):
        load_task("crossing", tmp_path)


@pytest.mark.parametrize("layout", [3, "3", "17"])
def test_the_error_of_an_unknown_number_lists_the_known_ones(layout: Any) -> None:
    with pytest.raises(
        ValueError, match=rf"^unknown layout {layout}: choose 0, 1, 2, random, generated or the path of a YAML file$"
    ):
        load_task("crossing", layout)


def test_the_error_of_an_unknown_task_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match=rf"^unknown task 'juggling': choose from {KNOWN_TASKS}$"):
        load_task("juggling", 0)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"goals": [[2, 1]]}, r"crossing_0\.yaml with overrides: unknown key 'goals'"),
        ({"goal": [[4, 6]]}, r"with overrides: goal tile \[4, 6\] is off the bridge"),
        ({"goal": [[2, 0.5]]}, r"with overrides: goal: a tile is two whole numbers"),
    ],
)
def test_overrides_are_checked_like_files(overrides: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_task("crossing", 0, overrides)


def test_an_error_speaks_of_overrides_only_if_there_are_some(tmp_path: Path) -> None:
    path = write(tmp_path, {**CROSSING, "goal": [[4, 6]]})
    with pytest.raises(ValueError, match=r"\.yaml: goal tile \[4, 6\] is off the bridge"):
        load_task("crossing", path, {"goal": None, "region": None})
