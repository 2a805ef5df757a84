"""One tidy table, a row per episode, and what it says: rates with intervals, paired tests with Holm's correction."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow
from omegaconf import DictConfig
from statsmodels.stats.multitest import multipletests

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.rollout import OUTCOMES
from cavin_pyro.evaluation.statistics import hierarchical_interval, mcnemar, wilson
from cavin_pyro.reproduction.cells import Cell
from cavin_pyro.reproduction.methods import METHODS
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


TEST = ["criterion", "in_paper", "scenes", "reference_alone", "other_alone", "p"]
REFERENCE = "cavin"  # which the others are compared with


def rates(table: pd.DataFrame) -> pd.DataFrame:
    """A row for every cell and criterion: episodes, outcomes, and two intervals of the rate of success.

    `low` and `high` are Wilson's at 95 %, as if all episodes were of one model; `seed_low` and `seed_high` are of the
    bootstrap that samples training seeds first and their episodes then.
    """
    found: list[dict[str, Any]] = []
    for cell, own in table.groupby(CELL, sort=False):
        for criterion in CRITERIA:
            outcomes = own[f"{criterion}_outcome"]
            success = outcomes == "success"
            low, high = hierarchical_interval(success.to_numpy(bool), own["training_seed"].to_numpy())
            found.append(
                {
                    **dict(zip(CELL, cell, strict=True)),
                    "criterion": criterion,
                    "episodes": len(own),
                    "successes": int(success.sum()),
                    **wilson(int(success.sum()), len(own)),
                    "seed_low": low,
                    "seed_high": high,
                    **{name: float((outcomes == name).mean()) for name in ("violation", "fall", "timeout")},
                }
            )
    return pd.DataFrame(found)


def paired_tests(table: pd.DataFrame) -> pd.DataFrame:
    """CAVIN against every other method with the same kind of planner: exact McNemar tests, episode by episode.

    `p_holm`: with Holm's correction. A family is all comparisons of one kind of planner and one criterion, with methods
    of the paper or with others, so that what the paper has is corrected as if no others were there.
    """
    found: list[tuple[Any, ...]] = []
    cells = dict(iter(table.groupby(CELL, sort=False)))
    for (method, *rest), other in cells.items():
        reference = cells.get((REFERENCE, *rest))
        if method == REFERENCE or reference is None:
            continue
        scenes = reference.merge(other, on=["training_seed", "seed"], suffixes=("", "_other"))
        for criterion in CRITERIA:
            ours, theirs = (scenes[f"{criterion}_outcome{side}"] == "success" for side in ("", "_other"))
            alone, other_alone = int((ours & ~theirs).sum()), int((theirs & ~ours).sum())
            found.append(
                (method, *rest, criterion, METHODS[method].in_paper)
                + (len(scenes), alone, other_alone, mcnemar(alone, other_alone))
            )
    tests = pd.DataFrame(found, columns=[*CELL, *TEST])
    families = tests.groupby(["planner", "criterion", "in_paper"])["p"]
    return tests.assign(p_holm=families.transform(lambda p_values: multipletests(p_values, method="holm")[1]))
