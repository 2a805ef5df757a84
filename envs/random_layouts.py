"""Layouts drawn anew at every reset: `layout=random`.

Insertion: "a slot is placed randomly along one of the sides of the table, surrounded by restricted area" (paper,
appendix "Task Details"). Every place of the tile grid is equally likely. The wall is two tiles deep and as long
as its side, the slot leads through its inner half, and objects start as in the fixed layouts of that side. The side
at the robot is left out: no push could start behind an object two tiles away from it, which lies at the end of the
reach.

Clearing and crossing: one of the three fixed layouts. The paper measures on fixed maps only, and a bridge of random
tiles may be one that no object can be pushed along.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from envs.layouts import BUILTIN_LAYOUTS, Layout, Tile, load_layout, parse_layout
from envs.workspace import TILE_COUNT

RANDOM = "random"
_ROWS, _COLUMNS = TILE_COUNT  # along x, away from the robot; along y


def possible_layouts(
    task: str, layout: int | str | Path, overrides: Mapping[str, Any] | None = None
) -> tuple[Layout, ...]:
    """The layouts that an episode may have, equally likely: one, or several for `layout=random`.

    Args:
        task, layout, overrides: as of `envs.layouts.load_layout`; `layout` may be `random` as well.

    Raises:
        ValueError: as `load_layout` does, or tiles are to replace those of a random layout.
    """
    if layout != RANDOM:
        return (load_layout(task, layout, overrides),)
    if any(tiles is not None for tiles in (overrides or {}).values()):
        raise ValueError("tiles replace fields of one layout: give layout=0, 1, 2 or a YAML file, not random")
    fixed = tuple(load_layout(task, number) for number in BUILTIN_LAYOUTS)
    return insertion_slots() if task == "insertion" else fixed


def insertion_slots() -> tuple[Layout, ...]:
    """Every place of the slot: three along either short side, one tile wide, and four along the far side, two wide."""
    short = [_slot_in_short_side(place, mirrored) for mirrored in (False, True) for place in range(1, _ROWS - 1)]
    return (*short, *(_slot_in_far_side(place) for place in range(1, _COLUMNS - 2)))


def _slot_in_short_side(place: int, mirrored: bool) -> Layout:
    """At the right end of the table as the robot sees it (small y), or mirrored at the left one; 2 is layout 0."""

    def column(number: int) -> int:
        return _COLUMNS - 1 - number if mirrored else number

    goal = {(place, column(1))}
    wall = {(row, column(number)) for row in range(_ROWS) for number in (0, 1)}
    target = {(2, column(number)) for number in (3, 4)}
    obstacles = {(row, column(number)) for row in (1, 2, 3) for number in (3, 4)}
    return _layout(wall - goal, goal, target, obstacles)


def _slot_in_far_side(place: int) -> Layout:
    """At the side opposite the robot, as layout 2, whose slot is that at 3."""
    goal = {(_ROWS - 2, place), (_ROWS - 2, place + 1)}
    wall = {(row, column) for row in (_ROWS - 2, _ROWS - 1) for column in range(_COLUMNS)}
    target = {(1, column) for column in range(2, 6)}
    obstacles = {(row, column) for row in (1, 2) for column in range(2, 6)}
    return _layout(wall - goal, goal, target, obstacles)


def _layout(region: set[Tile], goal: set[Tile], target_start: set[Tile], obstacle_start: set[Tile]) -> Layout:
    tiles = {"region": region, "goal": goal, "target_start": target_start, "obstacle_start": obstacle_start}
    return parse_layout("insertion", {name: sorted(some) for name, some in tiles.items()}, where="random slot")
