"""One tidy table: a row per episode, from which every figure and number follows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow
from omegaconf import DictConfig

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.rollout import OUTCOMES
from cavin_pyro.reproduction.cells import Cell
from cavin_pyro.storage.files import atomic_write

CRITERIA = ("strict", "published")
TABLE = "episodes.parquet"
CELL = ["method", "planner", "task", "reward", "objects"]
COLUMNS = {
    **dict.fromkeys(CELL[:-1], "string"),
    "objects": "int8",
    "training_seed": "int32",
    "seed": "int64",
    **{
        f"{criterion}_{name}": kind
        for criterion in CRITERIA
        for name, kind in (("outcome", "string"), ("steps", "int16"), ("return", "float64"))
    },
    **dict.fromkeys(("unsafe", "ineffective", "plans"), "int16"),
    "plans_reaching_goal": "int16",  # those that the model expects to reach the goal
    "subgoal_distance": "float64",  # metres, mean over segments; NaN for planners without subgoals
}


def episode_row(cell: Cell, row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the table from a line of `episodes.jsonl`, of an episode by the published criterion.

    Times are left out: they differ from run to run.
    """
    published = {f"published_{name}": row[name] for name in ("outcome", "steps", "return")}
    known = {**asdict(cell), **row, **published}
    return {name: known[name] for name in COLUMNS}


def as_table(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Rows as `episode_row` makes them."""
    return pd.DataFrame(list(rows), columns=list(COLUMNS)).astype(COLUMNS)


def write_table(path: Path, table: pd.DataFrame) -> None:
    """Write Parquet, whose bytes depend on the rows and on the versions of pandas and pyarrow alone."""
    with atomic_write(path) as temporary:
        table.to_parquet(temporary, index=False)


def read_table(path: Path) -> pd.DataFrame:
    """The table of a run, in its order; a UserError: the file cannot be read, or holds something else."""
    try:
        found = pd.read_parquet(path, columns=list(COLUMNS)).astype(COLUMNS)
        if not found[[f"{criterion}_outcome" for criterion in CRITERIA]].isin(OUTCOMES).all(axis=None):
            raise ValueError(f"an outcome is none of {', '.join(OUTCOMES)}")
        if found.duplicated([*CELL, "training_seed", "seed"]).any():
            raise ValueError("an episode is there twice")
        return found
    except (OSError, ValueError, KeyError, TypeError, pyarrow.ArrowException) as error:
        why = str(error).splitlines()[0]
        raise UserError(f"{path} is no table of episodes ({why}): give an episodes.parquet of reproduce") from error


def chosen_rows(table: pd.DataFrame, config: DictConfig) -> pd.DataFrame:
    """The rows that the options `methods`, `planners`, `tasks`, `rewards` and `objects` choose; a UserError: none."""
    for name in CELL:
        table = table[table[name].isin(list(config[name if name == "objects" else f"{name}s"]))]
    if table.empty:
        raise UserError(f"table={config.table} has no episode of these methods, planners, tasks, rewards and objects")
    return table
