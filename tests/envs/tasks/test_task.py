"""What every task has, and how one of a user's own is built."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from torch import Tensor

from envs.layouts import layout_numbers, load_task, parse_task, possible_tasks
from envs.pushing import PushingEnv
from envs.tasks import TASKS, Step, Task, TaskReward, TileSet
from envs.tasks.crossing import Crossing

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
    with pytest.raises(ValueError, match=r"^layout: places needs at least one tile$"):
        parse_task(Visit, {"places": [], **STARTS})


def test_a_reward_is_the_sum_of_its_named_terms(tmp_path: Path) -> None:
    path = tmp_path / "visit.yaml"
    path.write_text(yaml.safe_dump({"places": [[0, 0]], "shunned": [[4, 6]], **STARTS}))
    env = PushingEnv(task=Visit, layout=path, tiles={"bonus": 0.25}, objects=2)
    env.reset(seed=0)
    _, reward, *_, info = env.step(np.zeros(4, np.float32))
    assert info["terms"] == {"goal": 0, "violation": 0, "time": -1, "progress": 0, "away": 0.25}
    assert reward == -0.75
    assert TaskReward(env.task).maximum_return == math.inf
    env.close()


def test_nothing_is_a_violation_unless_the_task_says_so() -> None:
    task = Visit(places=[(0, 0)], **STARTS)
    centers = torch.rand(7, 2, 3)
    assert not TaskReward(task)(centers, centers, torch.tensor([True, True])).violation.any()


@pytest.mark.parametrize("layout", [0, "random"])
def test_a_task_without_layouts_here_asks_for_a_file(layout: int | str) -> None:
    assert layout_numbers(Visit) == ()
    with pytest.raises(ValueError, match=r"give layout=FILE.yaml|choose the path of a YAML file"):
        possible_tasks(Visit, layout)


def test_what_is_no_whole_task_is_refused() -> None:
    class Half(Task):
        def success(self, step: Step) -> Tensor:
            return step.mask[..., 0]

    with pytest.raises(ValueError, match=r"^task Half lacks potential$"):
        load_task(Half)
    with pytest.raises(ValueError, match=r"is no task: derive it from envs\.tasks\.Task$"):
        load_task(int)  # type: ignore[arg-type]


def test_a_class_without_the_decoration_of_its_fields_is_refused() -> None:
    class Plain(Visit):
        wanted: int = 2

    class Further(Visit):
        def success(self, step: Step) -> Tensor:
            return ~super().success(step)

    with pytest.raises(ValueError, match=r"^decorate Plain with @dataclass\(frozen=True, kw_only=True\)$"):
        load_task(Plain)
    assert isinstance(parse_task(Further, {"places": [[0, 0]], **STARTS}), Further)  # it has no fields of its own


MISTAKES: list[tuple[str, Callable[[Tensor], object], str]] = [
    ("success", Tensor.float, r"success must return bool \[\.\.\.\], here \[8, 6\], not float32 \[8, 6\]"),
    ("success", lambda right: right.unsqueeze(-1), r"success must return bool .*, not bool \[8, 6, 1\]"),
    ("success", lambda right: right[:, 0], r"success must return bool .*, not bool \[8\]"),
    ("success", lambda right: True, r"success must return bool .*, not builtins\.bool$"),
    ("violation", Tensor.float, r"violation must return bool .*, not float32 \[8, 1\]"),
    ("published_violation", Tensor.float, r"published_violation must return bool .*, not float32"),
    ("potential", lambda right: right.sum(-1), r"potential must return metres .*, here \[8, 7\], not float32 \[8\]"),
    ("potential", lambda right: right.sum(-1, keepdim=True), r"potential must return metres .*, not float32 \[8, 1\]"),
    ("potential", lambda right: right > 0, r"potential must return metres .*, not bool \[8, 7\]"),
]


@pytest.mark.parametrize(("function", "change", "message"), MISTAKES)
@pytest.mark.parametrize("objects", [1, 3])
def test_functions_of_a_users_task_are_checked_when_an_environment_is_built(
    function: str,
    change: Callable[[Tensor], object],
    message: str,
    objects: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right = getattr(Visit, function)
    monkeypatch.setattr(Visit, function, lambda self, *arguments: change(right(self, *arguments)))
    with pytest.raises(ValueError, match=f"^task Visit: {message}"):
        PushingEnv(task=Visit(places=[(0, 0)], **STARTS), objects=objects)


def test_constants_of_a_users_task_are_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Visit, "success", lambda self, step: torch.tensor(False))
    PushingEnv(task=Visit(places=[(0, 0)], **STARTS)).close()


def test_a_users_class_is_not_among_the_built_in_tasks() -> None:
    assert Visit not in TASKS.values()
    assert {"clearing", "insertion", "crossing"} <= set(TASKS)


def test_tasks_are_equal_where_their_tiles_are() -> None:
    one, other = (load_task("crossing", number) for number in (0, 1))
    assert one == load_task(Crossing, 0) and hash(one) == hash(load_task("crossing", 0))
    assert one != other
    assert len(one.region) == len(one.region.tiles) == len(set(one.region))
