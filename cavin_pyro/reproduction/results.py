"""Everything that follows from the table of episodes: figures, statistics and a page of results."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from cavin_pyro.reproduction.cells import PLANNERS
from cavin_pyro.reproduction.claims import claims
from cavin_pyro.reproduction.figure import TITLES, draw_figure
from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.reproduction.sizes import TOP_ROW_OBJECTS
from cavin_pyro.reproduction.statistics import paired_tests, rates
from cavin_pyro.reproduction.table import CELL, CRITERIA
from cavin_pyro.storage.files import atomic_write, write_json

HEAD = """# The paper's experiments

{episodes} episodes, scenes {first} to {last}, {trainings} training seed(s) of each method, objects told apart in the
depth image alone. Made by

    {command}

Intervals are at 95 %: Wilson's, as if all episodes were of one model. p: CAVIN against the method, episode by episode,
exact McNemar test with Holm's correction.
"""
ABOUT_CLAIMS = """Differences in points, with 95 % intervals (Newcombe's method 10). A lead is within chance unless its
whole interval is above 0 and p is below 0.05; a loss is, unless its whole interval is on one side of the paper's.
"""


def write_results(home: Path, table: pd.DataFrame, command: str) -> list[Path]:
    """Write figures, `statistics.json` and `results.md` (with the `command` that makes them anew); returns their paths.

    They follow from the table alone.
    """
    measured, compared = rates(table), paired_tests(table)
    write_json(home / "statistics.json", {"rates": measured.to_dict("records"), "tests": compared.to_dict("records")})
    seeds, trainings = table["seed"], table["training_seed"].nunique()
    counts = {"episodes": len(table), "trainings": trainings, "first": seeds.min(), "last": seeds.max()}
    lines, pictures = [HEAD.format(**counts, command=command)], []
    for planner in (name for name in PLANNERS if name in set(table["planner"])):
        for criterion in reversed(CRITERIA):  # the paper's figure is of the published one
            pictures.append(home / f"figure-{planner}-{criterion}.png")
            draw_figure(pictures[-1], measured, planner=planner, criterion=criterion)
            lines += [f"## {TITLES[planner].capitalize()}, criterion {criterion}", "", f"![]({pictures[-1].name})", ""]
            lines += [*markdown(_cells(measured, compared, planner, criterion)), ""]
            if found := claims(measured, compared, planner=planner, criterion=criterion):
                lines += ["The paper's claims:", "", *markdown(pd.DataFrame(found)), "", ABOUT_CLAIMS]
    with atomic_write(home / "results.md") as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")
    return [home / "results.md", home / "statistics.json", *pictures]


def markdown(table: pd.DataFrame) -> list[str]:
    """The lines of a table."""
    lines = [[str(name) for name in table], ["---"] * len(table.columns), *table.astype(str).values.tolist()]
    return [f"| {' | '.join(line)} |" for line in lines]


def _cells(measured: pd.DataFrame, compared: pd.DataFrame, planner: str, criterion: str) -> pd.DataFrame:
    """A row for each task, reward and number of objects, the top row of the figure first; a column for each method."""
    joined = measured.merge(compared[[*CELL, "criterion", "p_holm"]], how="left")
    own = joined[(joined["planner"] == planner) & (joined["criterion"] == criterion)]
    entries = own.assign(entry=own.apply(_entry, axis=1))
    cells = entries.pivot(index=["task", "reward", "objects"], columns="method", values="entry")
    methods = {name: method.label for name, method in METHODS.items() if name in cells}
    cells = cells[list(methods)].rename(columns=methods).fillna("").reset_index()
    return cells.sort_values("objects", key=lambda counts: counts != TOP_ROW_OBJECTS, kind="stable")


def _entry(rate: pd.Series) -> str:
    text = f"{100 * rate['rate']:.1f} % ({100 * rate['low']:.1f} to {100 * rate['high']:.1f}), n = {rate['episodes']}"
    return text if pd.isna(rate["p_holm"]) else f"{text}, p = {rate['p_holm']:.2g}"
