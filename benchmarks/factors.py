"""What networks, data and planner bring: `python benchmarks/factors.py docs/measurements/reproduction/factors.parquet`.

Two of each, so eight ways to play the same scenes: a row per way with its rate of success (95 % interval, Wilson) and
its mean pushes (a failed episode counts as the 60 that it may have); then a row per factor. Its effects are
the mean differences over the four pairs of ways that differ in this factor alone, in points of success and in pushes,
with 95 % intervals from resampling trainings and their scenes; then, for each pair, the scenes in which only one of the
two succeeds, and Holm's p of the exact McNemar test, corrected over all pairs of the table and criterion.

`--collect NAME=FOLDER ...` writes the table first, from folders of `reproduce` whose models were trained on less (NAME
of the first ones) and on more data.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
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
BUDGET = 60  # pushes of an episode
Values = Mapping[tuple[int, int], float]  # by training seed and scene


def collected(pairs: Sequence[str]) -> list[Row]:
    """Rows of folders of `reproduce`, with the name of their data."""
    named = [pair.partition("=")[::2] for pair in pairs]
    return [{**row, "data": name} for name, folder in named for row in read_table(Path(folder) / TABLE)]


def stored(path: Path) -> list[Row]:
    """Rows of a table that `--collect` wrote. Exits if it is none."""
    try:
        return parquet.read_table(path, columns=[*SCHEMA.names, "data"]).to_pylist()
    except (OSError, pyarrow.ArrowException) as error:
        sys.exit(f"error: {path} is no table of --collect ({str(error).splitlines()[0]}): write it from two runs")


def success(row: Row, criterion: str) -> float:
    """1 if the episode succeeds, else 0."""
    return float(row[f"{criterion}_outcome"] == "success")


def pushes(row: Row, criterion: str) -> float:
    """How many pushes it takes; all that it may have if it fails."""
    return float(row[f"{criterion}_steps"] if success(row, criterion) else BUDGET)


def ways(
    rows: Sequence[Row], criterion: str, value: Callable[[Row, str], float] = success
) -> dict[tuple[Any, ...], dict[tuple[int, int], float]]:
    """Of every way (networks, data, planner): a value of each scene."""
    found: dict[tuple[Any, ...], dict[tuple[int, int], float]] = {}
    for row in rows:
        way = tuple(row[COLUMNS[factor]] for factor in FACTORS)
        scenes = found.setdefault(way, {})
        scenes[row["training_seed"], row["seed"]] = value(row, criterion)
    return found


def levels(found: Mapping[tuple[Any, ...], Values], place: int) -> list[Any]:
    """The two levels of a factor, in the order of the table. Exits if there are not two, or a way is missing."""
    values = list(dict.fromkeys(way[place] for way in found))
    if len(values) != 2 or len(found) != 8 or len({frozenset(scenes) for scenes in found.values()}) != 1:
        sys.exit("error: the table must have eight ways, two of networks, data and planner each, of the same scenes")
    return values


def pairs(found: Mapping[tuple[Any, ...], Values], place: int) -> Iterator[tuple[Values, Values]]:
    """The four pairs of ways that differ in one factor alone."""
    one, other = levels(found, place)
    rest = [levels(found, number) for number in range(3) if number != place]
    for values in product(*rest):
        first, second = ((*values[:place], level, *values[place:]) for level in (one, other))
        yield found[first], found[second]


def effect(compared: Sequence[tuple[Values, Values]], seed: int = 0) -> tuple[float, float, float]:
    """The mean difference of values, other minus one, over all pairs, and its interval.

    Resampled are training seeds, then the scenes of each; a scene brings the values of all pairs along.
    """
    scenes = sorted(compared[0][0])
    gains = np.array([np.mean([other[scene] - one[scene] for one, other in compared]) for scene in scenes])
    seeds = np.array([training for training, _ in scenes])
    groups = [gains[seeds == training] for training in np.unique(seeds)]
    generator = np.random.default_rng(seed)
    means = [
        np.mean([generator.choice(groups[one], len(groups[one])).mean() for one in chosen])
        for chosen in generator.integers(len(groups), size=(RESAMPLES // 5, len(groups)))
    ]
    low, high = np.quantile(means, (0.025, 0.975))
    return float(np.mean([group.mean() for group in groups])), float(low), float(high)


def alone(one: Values, other: Values) -> tuple[int, int]:
    """Scenes that only the one, and only the other way solves."""
    return sum(one[s] > other[s] for s in one), sum(other[s] > one[s] for s in one)


def interval(values: tuple[float, float, float]) -> str:
    """An effect with its interval."""
    mean, low, high = values
    return f"{mean:+.1f} ({low:+.1f} to {high:+.1f})"


def lines(rows: Sequence[Row], criterion: str) -> Iterator[str]:
    """The tables of all numbers of objects, by one criterion."""
    numbers = sorted({row["objects"] for row in rows})
    parts = {number: [row for row in rows if row["objects"] == number] for number in numbers}
    solved = {number: ways(part, criterion) for number, part in parts.items()}
    taken = {number: ways(part, criterion, pushes) for number, part in parts.items()}
    titles = [f"{number} objects, {criterion}: success | pushes" for number in numbers]
    yield f"| networks | data | planner | {' | '.join(titles)} |"
    yield f"|{' --- |' * (3 + 2 * len(numbers))}"
    for way in solved[numbers[0]]:
        shown = []
        for number in numbers:
            outcomes = solved[number][way].values()
            one = wilson(int(sum(outcomes)), len(outcomes))
            shown.append(f"{100 * one['rate']:.1f} % ({100 * one['low']:.1f} to {100 * one['high']:.1f})")
            shown.append(f"{np.mean(list(taken[number][way].values())):.1f}")
        yield f"| {' | '.join(map(str, way))} | {' | '.join(shown)} |"
    compared = {(number, place): list(pairs(solved[number], place)) for number in numbers for place in range(3)}
    counts = [alone(*pair) for each in compared.values() for pair in each]
    tests = iter(holm([mcnemar(one, other) for one, other in counts]))
    yield ""
    yield "| factor | objects | effect, points | effect, pushes | each pair: alone before, alone after (p) |"
    yield "| --- | --- | --- | --- | --- |"
    for (number, place), each in compared.items():
        before, after = levels(solved[number], place)
        points = interval(tuple(100 * value for value in effect(each)))  # type: ignore[arg-type]
        fewer = interval(effect(list(pairs(taken[number], place))))
        shown = [f"{one}, {other} ({next(tests):.2g})" for one, other in (alone(*pair) for pair in each)]
        title = f"{FACTORS[place]}, `{after}` instead of `{before}`"
        yield f"| {title} | {number} | {points} | {fewer} | {'; '.join(shown)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", type=Path)
    parser.add_argument("--collect", nargs="+", metavar="NAME=FOLDER", help="of less data, then of more")
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
