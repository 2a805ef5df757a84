"""Finished episodes on disk: one line of JSON each, checked whenever they are read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.rollout import OUTCOMES

Row = dict[str, Any]
FIELDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("seed", "steps", "strict_steps", "unsafe", "ineffective", "plans", "plans_reaching_goal"), (int,)),
    **dict.fromkeys(("outcome", "strict_outcome"), (str,)),
    **dict.fromkeys(("return", "strict_return"), (int, float)),
    **dict.fromkeys(("shares_reaching_goal", "planning_ms"), (list,)),
    "subgoal_distance": (int, float, type(None)),
}


def violation(row: Any) -> str | None:
    """What makes a value no row of an episode; None if it is one."""
    if not isinstance(row, Mapping) or set(row) != set(FIELDS):
        return f"its keys must be {', '.join(FIELDS)}"
    wrong = next((name for name, kinds in FIELDS.items() if not _fits(name, row[name], kinds)), None)
    return None if wrong is None else f"{wrong} cannot be {json.dumps(row[wrong])[:40]}"


def _fits(name: str, value: Any, kinds: tuple[type, ...]) -> bool:
    """Whether a field is of its kinds: an outcome, or finite numbers, of which only returns may be negative."""
    if kinds == (str,):
        return value in OUTCOMES
    entries: list[Any] = value if isinstance(value, list) else [value]
    least = -math.inf if name.endswith("return") else 0.0
    numbers = all(one is None or (type(one) in (int, float) and least <= one < math.inf) for one in entries)
    return numbers and isinstance(value, kinds)


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
