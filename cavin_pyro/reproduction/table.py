"""One tidy table: a row per episode, from which every figure and number follows."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pyarrow
from pyarrow import parquet

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.rows import RENAMED, with_current_names
from cavin_pyro.reproduction.cells import Evaluation
from cavin_pyro.storage.files import atomic_write

CRITERIA = ("strict", "published")
TABLE = "episodes.parquet"
SCHEMA = pyarrow.schema(
    [
        ("method", pyarrow.string()),
        ("planner", pyarrow.string()),
        ("task", pyarrow.string()),
        ("reward", pyarrow.string()),
        ("objects", pyarrow.int8()),
        ("training_seed", pyarrow.int32()),
        ("seed", pyarrow.int64()),
        ("strict_outcome", pyarrow.string()),
        ("strict_steps", pyarrow.int16()),
        ("strict_return", pyarrow.float64()),
        ("published_outcome", pyarrow.string()),
        ("published_steps", pyarrow.int16()),
        ("published_return", pyarrow.float64()),
        ("unsafe", pyarrow.int16()),
        ("ineffective", pyarrow.int16()),
        ("plans", pyarrow.int16()),
        ("plans_reaching_goal", pyarrow.int16()),  # of these, those that the model expects to reach the goal
        ("subgoal_distance", pyarrow.float64()),  # metres, mean over segments; null for planners without subgoals
    ]
)
Row = dict[str, Any]


def episode_row(evaluation: Evaluation, row: Mapping[str, Any]) -> Row:
    """A row of the table from a line of `episodes.jsonl` (current names), of an episode by the published criterion.

    Times are left out: they differ from run to run.
    """
    cell = evaluation.cell
    return {
        "method": cell.method,
        "planner": cell.planner,
        "task": cell.task,
        "reward": cell.reward,
        "objects": cell.objects,
        "training_seed": evaluation.training_seed,
        "seed": row["seed"],
        **{f"strict_{name}": row[f"strict_{name}"] for name in ("outcome", "steps", "return")},
        **{f"published_{name}": row[name] for name in ("outcome", "steps", "return")},
        **{name: row[name] for name in ("unsafe", "ineffective", "plans", "plans_reaching_goal", "subgoal_distance")},
    }


def write_table(path: Path, rows: Iterable[Row]) -> None:
    """Write Parquet, whose bytes depend on the rows and on pyarrow's version alone."""
    with atomic_write(path) as temporary:
        parquet.write_table(pyarrow.Table.from_pylist(list(rows), schema=SCHEMA), temporary)


def read_table(path: Path) -> list[Row]:
    """The rows of a table, in their order.

    Raises:
        UserError: the file cannot be read, or holds something else.
    """
    try:
        stored = parquet.read_schema(path).names
        old_names = {new: old for old, new in RENAMED.items() if old in stored}
        schema = pyarrow.schema([field.with_name(old_names.get(field.name, field.name)) for field in SCHEMA])
        return [with_current_names(row) for row in parquet.read_table(path, schema=schema).to_pylist()]
    except (OSError, pyarrow.ArrowException) as error:
        why = str(error).splitlines()[0]
        raise UserError(f"{path} is no table of episodes ({why}): give an episodes.parquet of reproduce") from error


def row_key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """What tells an episode from all others in a table."""
    return tuple(row[name] for name in ("method", "planner", "task", "reward", "objects", "training_seed", "seed"))


def episode_key(evaluation: Evaluation, seed: int) -> tuple[Any, ...]:
    """`row_key` of an evaluation's episode in the scene `seed`."""
    cell = evaluation.cell
    place = cell.method, cell.planner, cell.task, cell.reward, cell.objects
    return *place, evaluation.training_seed, seed


def as_text(value: Any) -> str:
    """JSON whose bytes depend on the value alone."""
    return json.dumps(value, indent=1, sort_keys=True) + "\n"
