"""Everything that follows from the table of episodes: figures, statistics and a page of results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cavin_pyro.reproduction.cells import FIGURES, VARIANTS
from cavin_pyro.reproduction.claims import claims, section
from cavin_pyro.reproduction.episodes.failures import failures, failures_section
from cavin_pyro.reproduction.episodes.failures_figure import draw_failures
from cavin_pyro.reproduction.figure import TITLES, draw_figure
from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.reproduction.scales import TOP_ROW_OBJECTS
from cavin_pyro.reproduction.statistics import interquartile_means, paired_tests, rates
from cavin_pyro.reproduction.table import CRITERIA, Row
from cavin_pyro.storage.files import atomic_write, write_json

PAGE, STATISTICS = "results.md", "statistics.json"


def write_results(home: Path, rows: Sequence[Row], command: str) -> list[Path]:
    """Write figures, `statistics.json` and `results.md`, from the table alone; returns their paths.

    Args:
        command: the line that makes them anew, for the page.
    """
    measured = rates(rows)
    compared, means, counted = paired_tests(rows), interquartile_means(rows), failures(rows)
    statistics = {"rates": measured, "tests": compared, "interquartile_means": means, "failures": counted}
    write_json(home / STATISTICS, statistics)
    planners = [name for name in FIGURES if any(row["planner"] == name for row in rows)]
    figures = [(planner, criterion) for planner in planners for criterion in CRITERIA]
    failed = [
        (planner, criterion) for planner, criterion in figures if any(one["planner"] == planner for one in counted)
    ]
    for planner, criterion in figures:
        draw_figure(home / f"figure-{planner}-{criterion}.png", measured, planner=planner, criterion=criterion)
    for planner, criterion in failed:
        draw_failures(home / f"failures-{planner}-{criterion}.png", counted, planner=planner, criterion=criterion)
    sections = [_section(planner, criterion, measured, compared) for planner, criterion in figures]
    checked = [
        line
        for planner in planners
        for criterion in reversed(CRITERIA)  # the paper's figure is of the published one
        for line in section(
            claims(measured, compared, planner=planner, criterion=criterion), planner=planner, criterion=criterion
        )
    ]
    lines = [
        *_head(rows, command),
        *checked,
        *sections,
        *_variants(measured, compared),
        *failures_section(counted, failed),
    ]
    with atomic_write(home / PAGE) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")
    pictures = [
        home / f"{kind}-{planner}-{criterion}.png"
        for kind, drawn in (("figure", figures), ("failures", failed))
        for planner, criterion in drawn
    ]
    return [home / PAGE, home / STATISTICS, *pictures]


def _head(rows: Sequence[Row], command: str) -> list[str]:
    seeds = sorted({row["seed"] for row in rows})
    trainings = len({row["training_seed"] for row in rows})
    return [
        "# The paper's experiments",
        "",
        f"{len(rows)} episodes, scenes {seeds[0]} to {seeds[-1]}, {trainings} training seed(s) of each method, objects",
        "told apart in the depth image alone. Made by",
        "",
        f"    {command}",
        "",
        "Intervals are at 95 %: Wilson's, as if all episodes were of one model. p: CAVIN against the method, episode",
        "by episode, exact McNemar test with Holm's correction.",
        "",
    ]


def _variants(measured: Sequence[Mapping[str, Any]], compared: Sequence[Mapping[str, Any]]) -> list[str]:
    """What lies between the methods: a table with the paper's planners above their variants."""
    shown = [one for one in measured if (one["method"], one["planner"]) in VARIANTS]
    if not shown:
        return []
    p_values = {(*_key(one), one["criterion"]): one["p_holm"] for one in compared}
    tasks = list(dict.fromkeys(one["task"] for one in shown))
    columns = [(task, criterion) for criterion in CRITERIA for task in tasks]
    lines = [
        "## Between the methods, sparse rewards, 3 objects",
        "",
        "Without our additions, except what the second column says. p: against `paper` of the same method.",
        "",
        "| method | variant | " + " | ".join(f"{task}, {criterion}" for task, criterion in columns) + " |",
        "| --- " * (2 + len(columns)) + "|",
    ]
    places = {(*_key(one), one["criterion"]): one for one in measured}
    for method in dict.fromkeys(one["method"] for one in shown):
        for planner in ("paper", *(name for owner, name in VARIANTS if owner == method)):
            entries = []
            for task, criterion in columns:
                rate = places.get((method, planner, task, "sparse", TOP_ROW_OBJECTS, criterion))
                entries.append(_entry(rate, _of_criterion(p_values, criterion)) if rate else "")
            lines.append(f"| {METHODS[method].label} | `{planner}` | " + " | ".join(entries) + " |")
    return [*lines, ""]


def _of_criterion(p_values: Mapping[tuple[Any, ...], float], criterion: str) -> dict[tuple[Any, ...], float]:
    return {key[:-1]: value for key, value in p_values.items() if key[-1] == criterion and key[1] not in FIGURES}


def _section(planner: str, criterion: str, measured: Sequence[Mapping[str, Any]], compared: Sequence[Any]) -> str:
    own = [one for one in measured if one["planner"] == planner and one["criterion"] == criterion]
    p_values = {_key(one): one["p_holm"] for one in compared if one["criterion"] == criterion}
    present = {one["method"] for one in own}
    methods = [name for name, method in METHODS.items() if method.in_paper or name in present]
    lines = [
        f"## {TITLES.get(planner, planner).capitalize()}, criterion {criterion}",
        "",
        f"![](figure-{planner}-{criterion}.png)",
        "",
        "| task | reward | objects | " + " | ".join(METHODS[name].label for name in methods) + " |",
        "| --- " * (3 + len(methods)) + "|",
    ]
    cells = dict.fromkeys((one["task"], one["reward"], one["objects"]) for one in own)
    for task, reward, objects in sorted(cells, key=lambda cell: (cell[2] != TOP_ROW_OBJECTS, cell)):
        entries = []
        for name in methods:
            found = [
                one
                for one in own
                if (one["method"], one["task"], one["reward"], one["objects"]) == (name, task, reward, objects)
            ]
            entries.append(_entry(found[0], p_values) if found else "")
        lines.append(f"| {task} | {reward} | {objects} | " + " | ".join(entries) + " |")
    return "\n".join([*lines, ""])


def _entry(rate: Mapping[str, Any], p_values: Mapping[tuple[Any, ...], float]) -> str:
    text = f"{100 * rate['rate']:.1f} % ({100 * rate['low']:.1f} to {100 * rate['high']:.1f}), n = {rate['episodes']}"
    p = p_values.get(_key(rate))
    return text if p is None else f"{text}, p = {p:.2g}"


def _key(one: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(one[name] for name in ("method", "planner", "task", "reward", "objects"))
