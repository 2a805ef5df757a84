"""Where a task happens: tiles to clear, avoid or stay on, goal tiles, and the tiles on which objects start.

A layout is a small YAML file: `envs/layouts/` holds the paper's nine, any other file of that form is a new
task.

    task: crossing            # clearing, insertion or crossing
    region: [[2, 2], [2, 3]]  # clear of objects / no object may enter / the target must stay
    goal: [[2, 2]]            # where the target must arrive; empty for clearing
    target_start: [[2, 3]]
    obstacle_start: [[1, 3]]

Source: paper, appendix "Task Details"; the published implementation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from envs.workspace import TILE_COUNT

TASK_NAMES = ("clearing", "insertion", "crossing")
BUILTIN_LAYOUTS = (0, 1, 2)

Tile = tuple[int, int]
_FOLDER = Path(__file__).parent / "layouts"


@dataclass(frozen=True)
class Layout:
    """Tiles (i, j) of one task; see the module's text for what each field means to each task."""

    task: str
    region: tuple[Tile, ...]
    goal: tuple[Tile, ...]
    target_start: tuple[Tile, ...]
    obstacle_start: tuple[Tile, ...]


TILE_FIELDS = tuple(field.name for field in fields(Layout) if field.name != "task")


def load_layout(task: str, layout: int | str | Path, overrides: Mapping[str, Any] | None = None) -> Layout:
    """Read one of the builtin layouts or a YAML file, replace fields, and check the result.

    Args:
        task: one of `TASK_NAMES`. layout: 0, 1, 2, or the path of a YAML file.
        overrides: tile lists that replace those of the layout; None values are ignored.

    Raises:
        ValueError: unknown task or layout, unreadable file, or tiles that make no sense.
    """
    if task not in TASK_NAMES:
        raise ValueError(f"unknown task {task!r}: choose from {', '.join(TASK_NAMES)}")
    name = str(layout)
    if name.isdecimal():
        if int(name) not in BUILTIN_LAYOUTS:
            raise ValueError(f"unknown layout {name}: choose 0, 1, 2, random or the path of a YAML file")
        path = _FOLDER / f"{task}_{int(name)}.yaml"
    else:
        path = Path(name)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = error.strerror
        raise ValueError(f"layout {path} cannot be read ({reason}): give 0, 1, 2, random or a YAML file") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"layout {path} is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict):
        raise ValueError(f"layout {path} must hold the keys {', '.join(TILE_FIELDS)}")
    declared = content.pop("task", task)
    if declared not in TASK_NAMES:
        raise ValueError(f"layout {path}: unknown task {declared!r}, choose from {', '.join(TASK_NAMES)}")
    if declared != task:
        raise ValueError(f"layout {path} is for task {declared}: run it with task={declared}")
    content |= {name: tiles for name, tiles in (overrides or {}).items() if tiles is not None}
    where = f"layout {path} with overrides" if overrides else f"layout {path}"
    return parse_layout(task, content, where=where)


def parse_layout(task: str, content: Mapping[str, Any], *, where: str = "layout") -> Layout:
    """Check tile lists and build a `Layout`.

    Raises:
        ValueError: a key is unknown or missing, a tile is malformed, listed twice, or off the table, or the
            tiles contradict the task (named in the message).
    """
    unknown = sorted(set(content) - set(TILE_FIELDS), key=str)
    if unknown:
        valid = ", ".join(("task", *TILE_FIELDS))
        raise ValueError(f"{where}: unknown key {unknown[0]!r}, valid keys are {valid}")
    missing = [name for name in TILE_FIELDS if name not in content and name != "goal"]
    if missing:
        raise ValueError(f"{where}: the key {missing[0]!r} is missing")
    tiles = {name: _parse_tiles(content.get(name, []), f"{where}: {name}") for name in TILE_FIELDS}
    layout = Layout(task=task, **tiles)
    _check_sense(layout, where)
    return layout


def _parse_tiles(value: Any, where: str) -> tuple[Tile, ...]:
    if not isinstance(value, list | tuple):
        raise ValueError(f"{where} must be a list of tiles such as [[2, 3], [2, 4]], not {value!r}")
    tiles: list[Tile] = []
    for entry in value:
        is_pair = isinstance(entry, list | tuple) and len(entry) == 2
        if not (is_pair and all(type(index) is int for index in entry)):
            raise ValueError(f"{where}: a tile is two whole numbers such as [2, 3], not {entry!r}")
        tile = (entry[0], entry[1])
        if not all(0 <= index < count for index, count in zip(tile, TILE_COUNT, strict=True)):
            last = [count - 1 for count in TILE_COUNT]
            raise ValueError(f"{where}: tile {list(tile)} is off the table, which holds [0, 0] to {last}")
        if tile in tiles:
            raise ValueError(f"{where}: tile {list(tile)} is listed twice, tiles must not overlap")
        tiles.append(tile)
    return tuple(tiles)


def _check_sense(layout: Layout, where: str) -> None:
    for name in ("region", "target_start", "obstacle_start"):
        if not getattr(layout, name):
            raise ValueError(f"{where}: {name} needs at least one tile")
    if layout.task == "clearing":
        if layout.goal:
            raise ValueError(f"{where}: clearing has no goal tiles, leave goal empty")
        outside = set(layout.target_start) - set(layout.region)
        if outside:
            tile = list(min(outside))
            raise ValueError(f"{where}: target_start tile {tile} is outside the region to clear")
        return
    if not layout.goal:
        raise ValueError(f"{where}: {layout.task} needs at least one goal tile")
    begun = set(layout.goal) & set(layout.target_start)
    if begun:
        raise ValueError(f"{where}: tile {list(min(begun))} is both goal and target_start")
    if layout.task == "insertion":
        for name in ("goal", "target_start", "obstacle_start"):
            shared = set(getattr(layout, name)) & set(layout.region)
            if shared:
                raise ValueError(f"{where}: {name} tile {list(min(shared))} overlaps the restricted region")
    else:
        off = (set(layout.target_start) | set(layout.goal)) - set(layout.region)
        if off:
            raise ValueError(f"{where}: tile {list(min(off))} is off the bridge, add it to region")
