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
    wrong = [name for name, kinds in FIELDS.items() if not isinstance(row[name], kinds)]
    wrong += [name for name in ("outcome", "strict_outcome") if row[name] not in OUTCOMES]
    for name in () if wrong else FIELDS.keys() - {"outcome", "strict_outcome"}:
        for one in row[name] if isinstance(row[name], list) else [row[name]]:
            number = type(one) in (int, float) and math.isfinite(one) and (one >= 0 or name.endswith("return"))
            wrong += [] if number or one is None else [name]
    return f"{wrong[0]} cannot be {json.dumps(row[wrong[0]])[:40]}" if wrong else None


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
