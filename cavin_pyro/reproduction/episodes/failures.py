"""Why episodes fail, counted from the table: what ended them, and whether their plans had expected success."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cavin_pyro.reproduction.figure import TITLES
from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.reproduction.scales import TOP_ROW_OBJECTS
from cavin_pyro.reproduction.statistics import CELL, by_cell
from cavin_pyro.reproduction.table import CRITERIA, Row

SELDOM = 0.1  # share of an episode's plans
# Every episode that is no success is one of these.
FAILURES = {
    "violation": "violation",
    "fall": "fall",
    "never": "timeout, no plan expected success",
    "seldom": "timeout, few plans expected success",
    "promised": "timeout, plans expected success",
}


def kind_of(row: Mapping[str, Any], criterion: str) -> str:
    """`success`, or one of `FAILURES`.

    A plan expects success if its chosen candidate reaches the goal by the model. Of timeouts, `never` has no such plan,
    `seldom` has them in less than `SELDOM` of its plans, and in `promised` the robot did not deliver them.
    """
    outcome = str(row[f"{criterion}_outcome"])
    if outcome != "timeout":
        return outcome
    if row["plans_reaching_goal"] == 0:
        return "never"
    return "seldom" if row["plans_reaching_goal"] < SELDOM * row["plans"] else "promised"


def failures(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Counts of every kind of end, for every method, planner and task (sparse, 3 objects) and both criteria.

    `unsafe` and `ineffective` are shares of all pushes of the episodes as they were run, by the published criterion.
    """
    found = []
    for cell, own in by_cell(rows).items():
        named = dict(zip(CELL, cell, strict=True))
        if (named["reward"], named["objects"]) != ("sparse", TOP_ROW_OBJECTS):
            continue
        pushes = max(1, sum(row["published_steps"] for row in own))
        for criterion in CRITERIA:
            kinds = [kind_of(row, criterion) for row in own]
            found.append(
                {
                    **named,
                    "criterion": criterion,
                    "episodes": len(own),
                    **{kind: kinds.count(kind) for kind in ("success", *FAILURES)},
                    **{name: sum(row[name] for row in own) / pushes for name in ("unsafe", "ineffective")},
                }
            )
    return found


def failures_section(counted: Sequence[Mapping[str, Any]], figures: Sequence[tuple[str, str]]) -> list[str]:
    """Lines of Markdown: the rules, and a picture and a table for each planner and criterion in `figures`."""
    lines = [
        "## Why episodes fail",
        "",
        "Sparse reward, 3 objects; shares of episodes. A plan expects success if its chosen candidate reaches the goal",
        f"by the model. Timeouts: `never` had no such plan, `seldom` had them in less than {100 * SELDOM:.0f} % of its",
        "plans, in `promised` plans expected success more often, and the robot did not deliver it. `unsafe` and",
        "`ineffective`: shares of all pushes, also of those after the strict criterion's end.",
        "",
    ]
    for planner, criterion in figures:
        title = f"### {TITLES.get(planner, planner).capitalize()}, criterion {criterion}"
        picture = f"![](failures-{planner}-{criterion}.png)"
        lines += [title, "", picture, "", *failure_table(counted, planner, criterion), ""]
    return lines


def failure_table(counted: Sequence[Mapping[str, Any]], planner: str, criterion: str) -> list[str]:
    """Lines of a Markdown table: a row per task and method."""
    lines = [
        "| task | method | episodes | violation | fall | timeout: never | seldom | promised | unsafe | ineffective |",
        "| --- " * 10 + "|",
    ]
    own = [one for one in counted if (one["planner"], one["criterion"]) == (planner, criterion)]
    for one in sorted(own, key=lambda one: (one["task"], list(METHODS).index(one["method"]))):
        shares = [f"{100 * one[kind] / one['episodes']:.1f} %" for kind in FAILURES]
        pushes = [f"{100 * one[name]:.1f} %" for name in ("unsafe", "ineffective")]
        cells = [one["task"], METHODS[one["method"]].label, str(one["episodes"]), *shares, *pushes]
        lines.append("| " + " | ".join(cells) + " |")
    return lines
