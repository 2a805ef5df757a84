"""Finished episodes on disk: one line of JSON each, checked whenever they are read."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.rollout import OUTCOMES

Row = dict[str, Any]


def _count(value: Any) -> bool:
    return type(value) is int and value >= 0


def _number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _outcome(value: Any) -> bool:
    return value in OUTCOMES


def _shares(value: Any) -> bool:
    return isinstance(value, list) and all(one is None or (_number(one) and 0.0 <= one <= 1.0) for one in value)


FIELDS: dict[str, Callable[[Any], bool]] = {
    "seed": _count,
    "outcome": _outcome,
    "steps": _count,
    "return": _number,
    "strict_outcome": _outcome,
    "strict_steps": _count,
    "strict_return": _number,
    "unsafe": _count,
    "ineffective": _count,
    "plans": _count,
    "plans_reaching_goal": _count,
    "shares_reaching_goal": _shares,
    "subgoal_distance": lambda value: value is None or _number(value),
    "planning_ms": lambda value: isinstance(value, list) and all(_number(one) for one in value),
}


def violation(row: Any) -> str | None:
    """What makes a value no row of an episode; None if it is one."""
    if not isinstance(row, Mapping):
        return "it is no section"
    if unknown := sorted(set(row) - set(FIELDS)):
        return f"{unknown[0]!r} is unknown"
    if missing := [name for name in FIELDS if name not in row]:
        return f"{missing[0]!r} is missing"
    wrong = next((name for name, fits in FIELDS.items() if not fits(row[name])), None)
    return None if wrong is None else f"{wrong} cannot be {json.dumps(row[wrong])[:40]}"


def finished_episodes(path: Path) -> dict[int, Row]:
    """The rows of a file of episodes by their seeds, without lines that were cut off; none if there is no file.

    A line that is JSON but no episode, or has the seed of another one, is a `UserError`.
    """
    rows: dict[int, Row] = {}
    if not path.exists():
        return rows
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except ValueError as error:
        raise UserError(f"{path} is damaged ({error}): move it away to run its episodes again") from error
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            continue  # cut off by a kill: its episode is run again
        wrong = violation(row)
        if wrong is None and rows.get(row["seed"], row) != row:
            wrong = f"an earlier line has another episode with seed {row['seed']}"
        if wrong is not None:
            raise UserError(f"{path}, line {number} is no episode ({wrong}): delete that line to run it again")
        rows[row["seed"]] = row
    return rows
