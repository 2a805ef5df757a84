"""Layouts: files that list the tiles of a task's fields.

`TASK_N.yaml` in this folder is layout N of a task, `TASK_hard.yaml` our layout whose way is blocked; any other file of
that form is a new layout (docs/how-to/your-own-layout.md).

Source of the layouts of the paper's three tasks: appendix "Task Details"; the published implementation.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import yaml

from cavin_pyro.envs.tabletop.tasks import TASKS, GeneratedLayouts, Task
from cavin_pyro.envs.tabletop.tasks.reach import check_reach
from cavin_pyro.envs.tabletop.tasks.tiles import TileSet
from cavin_pyro.models.checks import check_choice

RANDOM, GENERATED, HARD = "random", "generated", "hard"
MOST = 100_000  # characters of a layout
_FOLDER = Path(__file__).parent


def task_class(task: str | type[Task]) -> type[Task]:
    """The class of a task, by its name; a class is returned unchanged.

    Raises ValueError: unknown name, or a class with missing methods or without the decoration that makes its fields.
    """
    if isinstance(task, str):
        check_choice("task", task, TASKS)
        return TASKS[task]
    if not (isinstance(task, type) and issubclass(task, Task)):
        raise ValueError(f"{task!r} is no task: derive it from cavin_pyro.envs.tabletop.tasks.Task")
    if task.__abstractmethods__:
        raise ValueError(f"task {task.__name__} lacks {' and '.join(sorted(task.__abstractmethods__))}")
    known = {field.name for field in fields(task)}
    annotated = inspect.get_annotations(task)
    if any(name not in known and "ClassVar" not in str(hint) for name, hint in annotated.items()):
        raise ValueError(f"decorate {task.__name__} with @dataclass(frozen=True, kw_only=True)")
    return task


def layout_numbers(task: str | type[Task]) -> tuple[int, ...]:
    """The layouts of a task in this folder."""
    return tuple(sorted(int(name) for name in _names(task_class(task)) if name.isdecimal()))


def possible_tasks(
    task: str | type[Task], layout: int | str | Path = 0, tiles: Mapping[str, Any] | None = None
) -> tuple[Task, ...]:
    """A task in each of the layouts that an episode may have, equally likely: one, or several for `layout=random`.

    `task`, `layout`, `tiles`: as in `load_task`; `layout` may be `random` as well: the task's `random_layouts`, or
    those in this folder. All get the fields of `tiles` that are no lists of tiles, such as `clearance`. Raises
    ValueError: as `load_task`, or tiles for `layout=random`.
    """
    if layout != RANDOM:
        return (load_task(task, layout, tiles),)
    options, kind = _options(task, RANDOM, tiles), task_class(task)
    sampled = tuple(replace(one, **options) for one in kind.random_layouts())
    sampled = sampled or tuple(load_task(kind, number, options) for number in layout_numbers(kind))
    if not sampled:
        raise ValueError(f"task {kind.name} has no layouts to sample from: give layout=FILE.yaml, not random")
    return sampled


def generate_task(
    task: str | type[Task],
    wanted: GeneratedLayouts,
    generator: np.random.Generator | None = None,
    tiles: Mapping[str, Any] | None = None,
) -> Task:
    """A task in a new generated layout.

    `generator`: None generates that of seed 0. `tiles`: fields that are no lists of tiles, as in `possible_tasks`.
    Raises ValueError: unknown task, a task without generated layouts, no layout as wanted, or tiles.
    """
    options = _options(task, GENERATED, tiles)
    generated = task_class(task).generate(wanted, generator or np.random.default_rng(0))
    return replace(generated, **options) if options else generated


def _options(task: str | type[Task], layout: str, tiles: Mapping[str, Any] | None) -> dict[str, Any]:
    """The fields given for a task in layouts that are sampled or generated, of which none may be a list of tiles."""
    given = {name: value for name, value in (tiles or {}).items() if value is not None}
    kinds = get_type_hints(task_class(task))
    if any(kinds.get(name, TileSet) is TileSet for name in given):
        numbers = ", ".join(map(str, layout_numbers(task)))
        raise ValueError(f"tiles replace fields of one layout: give layout={numbers} or a YAML file, not {layout}")
    return given


def load_task(task: str | type[Task], layout: int | str | Path = 0, tiles: Mapping[str, Any] | None = None) -> Task:
    """A task in one of its layouts, or in that of a YAML file.

    `task`: a name in `TASKS`, or a class. `layout`: a number, or the path of a YAML file. `tiles`: fields that replace
    those of the layout; None values are ignored. Raises ValueError: unknown task or layout, unreadable file, a key that
    is unknown or missing, tiles that contradict the task, or a start from which no pushes lead to the goal.
    """
    kind = task_class(task)
    path = _path(kind, layout)
    content = _read(path, kind)
    declared = content.pop("task", kind.name)
    if declared != kind.name:
        if declared not in tuple(TASKS):
            raise ValueError(f"layout {path}: unknown task {declared!r}, choose from {', '.join(TASKS)}")
        raise ValueError(f"layout {path} is for task {declared}: run it with task={declared}")
    overrides = {name: value for name, value in (tiles or {}).items() if value is not None}
    where = f"layout {path} with overrides" if overrides else f"layout {path}"
    try:
        made = parse_task(kind, content | overrides)
        if kind in TASKS.values():  # a user's task may need more than one object
            check_reach(made)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    return made


def parse_task(task: str | type[Task], content: Mapping[str, Any]) -> Task:
    """A task in the layout that `content`, lists of tiles by field, describes.

    Raises ValueError: a key is unknown or missing, or tiles contradict the task.
    """
    kind = task_class(task)
    keys = kind.layout_keys()
    if unknown := sorted(set(content) - set(keys), key=str):
        raise ValueError(f"unknown key {unknown[0]!r}, valid keys are {', '.join(('task', *keys))}")
    if missing := [name for name, required in keys.items() if required and name not in content]:
        raise ValueError(f"the key {missing[0]!r} is missing")
    return kind(**content)


def _names(kind: type[Task]) -> list[str]:
    return sorted(path.stem.removeprefix(f"{kind.name}_") for path in _FOLDER.glob(f"{kind.name}_*.yaml"))


def _path(kind: type[Task], layout: int | str | Path) -> Path:
    name = str(layout)
    if name != HARD and not name.isdecimal():
        return Path(name)
    path = _FOLDER / f"{kind.name}_{name if name == HARD else int(name)}.yaml"
    if not path.exists():
        raise ValueError(f"unknown layout {name}: choose {_choices(kind)}")
    return path


def _read(path: Path, kind: type[Task]) -> dict[Any, Any]:
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read(MOST + 1)
        if len(text) > MOST:
            raise ValueError(f"it has more than {MOST} characters")
        content, nodes = yaml.safe_load(text), getattr(yaml.compose(text, yaml.SafeLoader), "value", ())
    except OSError as error:
        raise ValueError(f"layout {path} cannot be read ({error.strerror}): give {_choices(kind)}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"layout {path} is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise ValueError(f"layout {path} must hold the keys {', '.join(kind.layout_keys())}")
    keys = [key.value for key, _ in nodes]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise ValueError(f"layout {path} has the key {twice[0]!r} twice: give it once")
    return content


def _choices(kind: type[Task]) -> str:
    """`0, 1, 2, random or the path of a YAML file`, as far as the task has them."""
    names = [*_names(kind), RANDOM, GENERATED]
    return f"{', '.join(names)} or the path of a YAML file" if len(names) > 2 else "the path of a YAML file"
