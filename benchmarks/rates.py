"""Rates of a table of episodes: `python benchmarks/rates.py docs/measurements/reproduction/shipped.parquet`.

A line per planner, task, reward, number of objects and criterion: success with its 95 % interval (Wilson), why the
others failed, and the median number of pushes of a success. `--collect NAME=FOLDER ...` writes the table first, from
folders of `evaluate`; NAME stands in the table's column of planners. An evaluation by the strict criterion does not
know what the published one would say.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections import Counter, defaultdict
from pathlib import Path

from omegaconf import OmegaConf

from cavin_pyro.evaluation.rows import with_current_names
from cavin_pyro.evaluation.statistics import wilson
from cavin_pyro.reproduction.cells import Cell, Evaluation
from cavin_pyro.reproduction.table import CRITERIA, Row, episode_row, read_table, write_table

KEYS = ("planner", "task", "reward", "objects")


def collected(name: str, folder: Path, training_seed: int) -> list[Row]:
    """Rows of one evaluation."""
    config = OmegaConf.load(folder / "config.yaml")
    cell = Cell("cavin", name, config.task._target_.split(".")[-2], config.reward, config.objects)
    rows = [with_current_names(json.loads(line)) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    found = [episode_row(Evaluation(cell, training_seed, config.seed, len(rows)), row) for row in rows]
    unknown = {name: None for name in found[0] if name.startswith("published_") and config.criterion == "strict"}
    return [row | unknown for row in found]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", type=Path)
    parser.add_argument("--collect", nargs="+", default=[], metavar="NAME=FOLDER")
    parser.add_argument("--training-seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.collect:
        pairs = [one.partition("=")[::2] for one in arguments.collect]
        write_table(
            arguments.table,
            [row for name, folder in pairs for row in collected(name, Path(folder), arguments.training_seed)],
        )
    groups: dict[tuple[object, ...], list[Row]] = defaultdict(list)
    for row in read_table(arguments.table):
        groups[tuple(row[key] for key in KEYS)].append(row)
    print("| name | task | objects | criterion | episodes | success | violation | fall | timeout | median pushes |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for (planner, task, _, objects), rows in groups.items():
        for criterion in CRITERIA:
            ends = Counter(row[f"{criterion}_outcome"] for row in rows)
            if None in ends:
                continue
            rate = wilson(ends["success"], len(rows))
            won = [row[f"{criterion}_steps"] for row in rows if row[f"{criterion}_outcome"] == "success"]
            failed = " | ".join(str(ends[end]) for end in ("violation", "fall", "timeout"))
            success = f"{rate['rate']:.1%} ({100 * rate['low']:.1f} to {100 * rate['high']:.1f})"
            print(
                f"| `{planner}` | {task} | {objects} | {criterion} | {len(rows)} | {success} | {failed} | "
                f"{statistics.median(won) if won else '-'} |"
            )


if __name__ == "__main__":
    main()
