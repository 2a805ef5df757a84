"""What networks, data and planner bring: `python benchmarks/factors.py docs/measurements/factors-episodes.parquet`.

Two of each, so eight ways to play the same scenes: a row per way with its rate of success (95 % interval, Wilson), then
a row per factor. Its effect is the mean difference over the four pairs of ways that differ in this factor alone, in
points, with a 95 % interval from resampling trainings and their scenes; then, for each pair, the scenes in which only
one of the two succeeds, and Holm's p of the exact McNemar test, corrected over all pairs of the table and criterion.

`--collect NAME=FOLDER NAME=FOLDER` writes the table first, from two folders of `reproduce` whose models were trained on
less and on more data.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from pyarrow import parquet

from cavin_pyro.evaluation.statistics import mcnemar, wilson
from cavin_pyro.reproduction.statistics import RESAMPLES, holm
from cavin_pyro.reproduction.table import CRITERIA, SCHEMA, TABLE, Row, read_table
from cavin_pyro.storage.files import atomic_write

FACTORS = ("networks", "data", "planner")
COLUMNS = {"networks": "method", "data": "data", "planner": "planner"}
Solved = Mapping[tuple[int, int], bool]  # whether, by training seed and scene


def collected(pairs: Sequence[str]) -> list[Row]:
    """Rows of two folders of `reproduce`, with the name of their data."""
    named = [pair.partition("=")[::2] for pair in pairs]
    return [{**row, "data": name} for name, folder in named for row in read_table(Path(folder) / TABLE)]


def stored(path: Path) -> list[Row]:
    """Rows of a table that `--collect` wrote. Exits if it is none."""
    try:
        return parquet.read_table(path, columns=[*SCHEMA.names, "data"]).to_pylist()
    except (OSError, pyarrow.ArrowException) as error:
        sys.exit(f"error: {path} is no table of --collect ({str(error).splitlines()[0]}): write it from two runs")


def ways(rows: Sequence[Row], criterion: str) -> dict[tuple[Any, ...], dict[tuple[int, int], bool]]:
    """Of every way (networks, data, planner): which scenes it solves."""
    found: dict[tuple[Any, ...], dict[tuple[int, int], bool]] = {}
    for row in rows:
        way = tuple(row[COLUMNS[factor]] for factor in FACTORS)
        scenes = found.setdefault(way, {})
        scenes[row["training_seed"], row["seed"]] = row[f"{criterion}_outcome"] == "success"
    return found


def levels(found: Mapping[tuple[Any, ...], Solved], place: int) -> list[Any]:
    """The two levels of a factor, in the order of the table. Exits if there are not two, or a way is missing."""
    values = list(dict.fromkeys(way[place] for way in found))
    if len(values) != 2 or len(found) != 8 or len({frozenset(scenes) for scenes in found.values()}) != 1:
        sys.exit("error: the table must have eight ways, two of networks, data and planner each, of the same scenes")
    return values


def pairs(found: Mapping[tuple[Any, ...], Solved], place: int) -> Iterator[tuple[Solved, Solved]]:
    """The four pairs of ways that differ in one factor alone."""
    one, other = levels(found, place)
    rest = [levels(found, number) for number in range(3) if number != place]
    for values in product(*rest):
        first, second = ((*values[:place], level, *values[place:]) for level in (one, other))
        yield found[first], found[second]


def effect(compared: Sequence[tuple[Solved, Solved]], seed: int = 0) -> tuple[float, float, float]:
    """The mean difference of rates, other minus one, over all pairs, and its interval, in points.

    Resampled are training seeds, then the scenes of each; a scene brings the outcomes of all pairs along.
    """
    scenes = sorted(compared[0][0])
    gains = np.array([100 * np.mean([other[scene] - one[scene] for one, other in compared]) for scene in scenes])
    seeds = np.array([training for training, _ in scenes])
    groups = [gains[seeds == training] for training in np.unique(seeds)]
    generator = np.random.default_rng(seed)
    means = [
        np.mean([generator.choice(groups[one], len(groups[one])).mean() for one in chosen])
        for chosen in generator.integers(len(groups), size=(RESAMPLES // 5, len(groups)))
    ]
    low, high = np.quantile(means, (0.025, 0.975))
    return float(np.mean([group.mean() for group in groups])), float(low), float(high)


def alone(one: Solved, other: Solved) -> tuple[int, int]:
    """Scenes that only the one, and only the other way solves."""
    return sum(one[s] and not other[s] for s in one), sum(other[s] and not one[s] for s in one)


def lines(rows: Sequence[Row], criterion: str) -> Iterator[str]:
    """The tables of all numbers of objects, by one criterion."""
    numbers = sorted({row["objects"] for row in rows})
    found = {number: ways([row for row in rows if row["objects"] == number], criterion) for number in numbers}
    yield f"| networks | data | planner | {' | '.join(f'{number} objects, {criterion}' for number in numbers)} |"
    yield f"|{' --- |' * (3 + len(numbers))}"
    for way in found[numbers[0]]:
        rates = [wilson(sum(scenes[way].values()), len(scenes[way])) for scenes in found.values()]
        shown = [f"{100 * one['rate']:.1f} % ({100 * one['low']:.1f} to {100 * one['high']:.1f})" for one in rates]
        yield f"| {' | '.join(map(str, way))} | {' | '.join(shown)} |"
    compared = {(number, place): list(pairs(found[number], place)) for number in numbers for place in range(3)}
    counts = [alone(*pair) for each in compared.values() for pair in each]
    tests = iter(holm([mcnemar(one, other) for one, other in counts]))
    yield ""
    yield "| factor | objects | effect, points | each pair: alone before, alone after (p) |"
    yield "| --- | --- | --- | --- |"
    for (number, place), each in compared.items():
        mean, low, high = effect(each)
        before, after = levels(found[number], place)
        shown = [f"{one}, {other} ({next(tests):.2g})" for one, other in (alone(*pair) for pair in each)]
        title = f"{FACTORS[place]}, `{after}` after `{before}`"
        yield f"| {title} | {number} | {mean:+.1f} ({low:+.1f} to {high:+.1f}) | {'; '.join(shown)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", type=Path)
    parser.add_argument("--collect", nargs=2, metavar="NAME=FOLDER", help="less data, then more")
    arguments = parser.parse_args()
    if arguments.collect:
        schema = SCHEMA.append(pyarrow.field("data", pyarrow.string()))
        with atomic_write(arguments.table) as temporary:
            parquet.write_table(pyarrow.Table.from_pylist(collected(arguments.collect), schema=schema), temporary)
    rows = stored(arguments.table)
    for criterion in CRITERIA:
        print("\n".join((*lines(rows, criterion), "")))


if __name__ == "__main__":
    main()
