"""Join the tables of shards."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from cavin_pyro.config.errors import UserError
from cavin_pyro.reproduction.cells import evaluations, in_order
from cavin_pyro.reproduction.methods import chosen_methods
from cavin_pyro.reproduction.pipeline import chosen_scale
from cavin_pyro.reproduction.scales import SCALES
from cavin_pyro.reproduction.table import TABLE, as_text, episode_key, read_table, row_key, write_table
from cavin_pyro.storage.run_directory import check_same_run

# Options that may change when a run goes on.
EXTENDED = ("planners", "tasks", "objects", "rewards", "episodes", "bottom_episodes", "extends")
IGNORED = ("output", "workers", "shard", "merge", "pictures", *EXTENDED)


def check_shards(folders: Sequence[Path]) -> None:
    """Check that there is a table in each folder.

    Raises:
        UserError: a folder holds no finished shard.
    """
    for folder in folders:
        if not (folder / TABLE).is_file():
            raise UserError(f"merge={folder} holds no {TABLE}: let its shard end first")


def merge_tables(config: DictConfig, home: Path, folders: Sequence[Path]) -> list[dict[str, Any]]:
    """Join the episodes of shards, in the order that a run of all of them has, and write the table.

    Raises:
        UserError: a folder holds a shard of other options, episodes are missing, or two shards have one differently.
    """
    rows: dict[tuple[Any, ...], dict[str, Any]] = {}
    for folder in folders:
        check_same_run(folder, config, ignore=IGNORED)
        for row in read_table(folder / TABLE):
            same = rows.setdefault(row_key(row), row)
            if as_text(same) != as_text(row):
                raise UserError(
                    f"merge={folder} has another episode of {row['method']} in {row['task']}, scene {row['seed']}, "
                    "than a folder before it: give shards of one run"
                )
    wanted = [
        episode_key(one, seed)
        for one in evaluations(chosen_scale(config), chosen_methods(config), config.planners)
        for seed in range(one.seed, one.seed + one.episodes)
    ]
    missing = [key for key in wanted if key not in rows]
    if missing:
        method, _, task, *_, training_seed, _ = missing[0]
        raise UserError(
            f"the folders of merge lack {len(missing)} of {len(wanted)} episodes, the first of {method} in {task} with "
            f"training seed {training_seed}: give every shard's folder"
        )
    ordered = in_order(list(rows.values()), SCALES[config.scale])  # also those that the table `extends` had
    write_table(home / TABLE, ordered)
    return ordered
