"""Write the tables of docs/results.md and README.md from docs/results: `python benchmarks/tables.py`.

A table stands between `<!-- table: NAME -->` and `<!-- end -->`. Each follows from one file of docs/results with a row
per episode (or per measured time, or predicted object), which also names the commit that ran it. Rates have Wilson's
intervals at 95 %; two planners in the same scenes are compared by the exact McNemar test.
"""

from __future__ import annotations

import re
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import product
from typing import Any

import records
from records import RESULTS, ROOT
from records import Record as Row

from cavin_pyro.evaluation.statistics import mcnemar, wilson

PAGES = (ROOT / "README.md", ROOT / "docs" / "results.md")
MARKERS = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
TASKS = ("clearing", "insertion", "crossing")
RULES = ("published", "strict")
METHODS = {"cavin": "CAVIN", "contact": "CAVIN, contact", "sectar": "SeCTAR", "cvae_mpc": "CVAE-MPC", "mpc": "MPC"}
WORLDS = "75 ahead", "maze"  # of Push-T, and the other one


def read(name: str) -> list[Row]:
    """The rows of docs/results/NAME.parquet."""
    return records.read(RESULTS / f"{name}.parquet")


def groups(rows: Iterable[Row], *keys: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by the values of these columns, in the order of their first appearance."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    return found


def markdown(head: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    body = [head, ["---"] * len(head), *lines]
    return "".join(f"| {' | '.join(map(str, line))} |\n" for line in body)


def rate(rows: Sequence[Row], outcome: str = "outcome") -> str:
    """Success with its interval, in per cent."""
    if not rows:
        return ""
    found = wilson(sum(row[outcome] == "success" for row in rows), len(rows))
    return f"{100 * found['rate']:.1f} % ({100 * found['low']:.1f}–{100 * found['high']:.1f})"


def seeds(rows: Sequence[Row]) -> str:
    """The blocks of seeds, those that follow one another as one."""
    blocks: list[list[int]] = []
    for number in sorted({row["seed"] for row in rows}):
        if blocks and number == blocks[-1][1] + 1:
            blocks[-1][1] = number
        else:
            blocks.append([number, number])
    return ", ".join(f"{first} to {last}" for first, last in blocks)


def paired(one: Sequence[Row], other: Sequence[Row]) -> tuple[int, int, float]:
    """Scenes that only the one solves, that only the other solves, and the p of the exact McNemar test."""
    theirs = {row["seed"]: row["outcome"] == "success" for row in other}
    pairs = [(row["outcome"] == "success", theirs[row["seed"]]) for row in one if row["seed"] in theirs]
    alone, others = pairs.count((True, False)), pairs.count((False, True))
    return alone, others, mcnemar(alone, others)


def readme() -> str:
    """Four ways to plan: success in the tabletop by the strict rules, with three objects, and in other worlds."""
    strict = [row for row in read("success") if row["rules"] == "strict" and row["row"].endswith(", 3 objects")]
    planned = groups(strict, "planner", "task")
    figure = [row for row in read("reproduction") if (row["planner"], row["reward"]) == ("paper", "sparse")]
    baselines = groups([row for row in figure if row["objects"] == 3], "method", "task")
    pushed = groups(read("worlds"), "row", "task")
    cells: dict[str, tuple[list[Sequence[Row]], str, str]] = {
        "ours": ([planned["cavin", task] for task in TASKS], "outcome", "cascade"),
        "Algorithm 1": ([planned["paper", task] for task in TASKS], "outcome", ""),
        "a script": ([planned["scripted", task] for task in TASKS], "outcome", ""),
        "actions alone": ([baselines["mpc", task] for task in TASKS], "strict_outcome", "flat: actions"),
    }
    lines = [
        [name, *(rate(rows, outcome) for rows in found), *(rate(pushed.get((row, world), [])) for world in WORLDS)]
        for name, (found, outcome, row) in cells.items()
    ]
    return markdown(["", *TASKS, "Push-T", "maze"], lines)


def success(name: str = "success") -> str:
    """One line per row and rules: success, pushes and failures of each task, with their seeds."""
    rows = read(name)
    tasks = list(groups(rows, "task"))
    lines = []
    for (row, rules), found in groups(rows, "row", "rules").items():
        by_task = groups(found, "task")
        counts = ", ".join(dict.fromkeys(str(len(by_task[task])) for task in tasks if task in by_task))
        ends = [_ends(by_task[task]) if task in by_task else "" for task in tasks]
        lines.append([row, rules, counts, *ends, seeds(found)])
    return markdown(["row", "rules", "episodes", *(task for (task,) in tasks), "seeds"], lines)


def _ends(rows: Sequence[Row]) -> str:
    """Success with its interval; mean pushes; violations, falls and timeouts."""
    ends = Counter(row["outcome"] for row in rows)
    steps = [row["steps"] for row in rows if row["outcome"] == "success"]
    mean = f"{statistics.mean(steps):.1f}" if steps else "-"
    return f"{rate(rows)}; {mean}; {ends['violation']}, {ends['fall']}, {ends['timeout']}"


def additions() -> str:
    """Each addition left out, beside all of them in the same scenes."""
    rows = read("additions")
    cells = groups(rows, "task", "objects")
    everything = groups([row for row in rows if row["row"] == "nothing"], "task", "objects")
    lines = []
    for (name,), of_row in groups(rows, "row").items():
        by_cell = groups(of_row, "task", "objects")
        line: list[object] = [name, ", ".join(str(len(by_cell.get(cell, []))) for cell in cells)]
        for cell in cells:
            found = by_cell.get(cell, [])
            if not found:
                line += ["", ""]
                continue
            without, complete, _ = paired(found, everything[cell])
            text = rate(found).partition(" (")[0]
            violations = sum(row["outcome"] in ("violation", "fall") for row in found)
            steps = statistics.mean(row["steps"] for row in found if row["outcome"] == "success")
            line += [text if name == "nothing" else f"{text} ({without}, {complete})", f"{violations}, {steps:.1f}"]
        lines.append(line)
    head = [text for task, objects in cells for text in (f"{task}, {objects}", "violations and falls, pushes")]
    return f"{markdown(['left out', 'scenes', *head], lines)}\nSeeds {seeds(rows)}.\n"


def crossed(rows: Iterable[Row], line: Sequence[str], cell: Sequence[str], cells: Sequence[tuple[Any, ...]]) -> str:
    """A line for each combination of some columns, and in it the success for combinations of others."""
    lines = [
        [*name, *(rate(groups(found, *cell).get(one, [])) for one in cells)]
        for name, found in groups(rows, *line).items()
    ]
    return markdown([*line, *(", ".join(map(str, one)) for one in cells)], lines)


def layouts() -> str:
    """Each planner in each layout."""
    rows = [{**row, "planner": row["row"].partition(",")[0]} for row in read("layouts")]
    return crossed(rows, ("planner", "rules"), ("task", "layout"), sorted(groups(rows, "task", "layout")))


def figure(name: str, rules: Sequence[str] = RULES, **only: object) -> list[Row]:
    """Episodes of a figure, once by each of the rules, in the order of its methods."""
    rows = [row for row in read(name) if only.items() <= row.items()]
    return [
        {**row, "method": METHODS[method], "rules": one, "outcome": row[f"{one}_outcome"]}
        for one, method in product(rules, METHODS)
        for row in rows
        if row["method"] == method
    ]


def reproduction(name: str) -> str:
    """The bars of the paper's figure, planners as in the paper."""
    rows = figure(name, planner="paper", objects=3)
    return crossed(rows, ("method", "rules"), ("task", "reward"), list(product(TASKS, ("dense", "sparse"))))


def more_objects() -> str:
    """Clearing with sparse rewards against the number of objects, planners as in the paper."""
    rows = figure("reproduction", ("published",), planner="paper", reward="sparse", task="clearing")
    return crossed(rows, ("method",), ("objects",), [(count,) for count in range(1, 6)])


def variants() -> str:
    """Parts of CAVIN left out, planners otherwise as in the paper, beside SeCTAR."""
    rows = [row for row in figure("reproduction", reward="sparse", objects=3) if row["method"] in ("CAVIN", "SeCTAR")]
    return crossed(rows, ("method", "planner"), ("rules", "task"), list(product(RULES, TASKS)))


def accuracy() -> str:
    """Errors of predicted centres, in centimetres, of objects that moved and that did not."""
    rows = read("accuracy")
    who = list(dict.fromkeys(row["predictor"] for row in rows))
    lines = []
    for ahead in sorted({row["pushes"] for row in rows}):
        pushes = f"{ahead} push{'es' * (ahead > 1)}"
        for name, objects in {"all": range(1, 6), "five objects": [5]}.items():
            cells = {one: [row for row in rows if row["pushes"] == ahead and row["predictor"] == one] for one in who}
            moved = {
                one: [100 * row["error"] for row in cells[one] if row["moved"] and row["objects"] in objects]
                for one in who
            }
            lines.append([f"{pushes}, {name}", len(moved[who[0]]), *map(_errors, moved.values())])
        still = {one: [row["phantom"] for row in cells[one] if not row["moved"]] for one in who}
        shares = [f"{100 * statistics.mean(still[one]):.2f} %" if any(still[one]) else "" for one in who]
        lines.append([f"{pushes}, still but said to move", len(still[who[0]]), *shares])
    return markdown(["mean / median error, cm", "objects", *who], lines)


def _errors(values: Sequence[float]) -> str:
    return f"{statistics.mean(values):.2f} / {statistics.median(values):.2f}" if values else ""


def worlds() -> str:
    """Success in other worlds, that of each training, and in the same pairs against the row that it is a variant of."""
    rows = read("worlds")
    tasks, lines = list(groups(rows, "task")), []
    for (name,), found in groups(rows, "row").items():
        line, whole = list[object]([name]), name.partition(", ")[0]
        for task in tasks:
            cell = groups(found, "task").get(task, [])
            by_training = sorted(groups(cell, "checkpoint").items())
            shares = [
                f"{100 * statistics.mean(row['outcome'] == 'success' for row in some):.0f}" for _, some in by_training
            ]
            first = groups(rows, "row", "task").get((whole if whole != name else rows[0]["row"], *task), [])
            alone, others, p = paired(cell, first)
            test = f"; {alone}, {others} (p = {p:.2g})" if alone or others else ""
            line += [len(cell) or "", f"{rate(cell)}; {', '.join(shares)}{test}" if cell else ""]
        lines.append(line)
    return markdown(["", *(text for (task,) in tasks for text in ("pairs", task))], lines)


def speed() -> str:
    """Measured times as they are, a line per row."""
    rows = read("speed")
    return markdown(list(rows[0]), [["" if value is None else value for value in row.values()] for row in rows])


TABLES: dict[str, Callable[[], str]] = {
    **{name: partial(success, name) for name in ("success", "hard", "farther")},
    **{name: partial(reproduction, name) for name in ("reproduction", "standard_prior")},
    **{one.__name__: one for one in (readme, layouts, additions, more_objects, variants, accuracy, worlds, speed)},
}


def written(text: str) -> str:
    """A page with its tables as the files of docs/results have them."""

    def table(found: re.Match[str]) -> str:
        name = {"readme": "success", "more_objects": "reproduction", "variants": "reproduction"}.get(found[2], found[2])
        exists = (RESULTS / f"{name}.parquet").exists()
        return f"{found[1]}\n{TABLES[found[2]]() if exists else 'Not measured yet.'}\n{found[3]}"

    return MARKERS.sub(table, text)


def main() -> None:
    for page in PAGES:
        page.write_text(written(page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
