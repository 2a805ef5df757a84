"""Which episodes are pictured: of every task, the first successes and the first failures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from cavin_pyro.reproduction.episodes.failures import kind_of
from cavin_pyro.reproduction.scales import TOP_ROW_OBJECTS
from cavin_pyro.reproduction.table import Row

EACH = 3  # successes, and failures
CHOSEN = {"method": "cavin", "planner": "paper", "reward": "sparse", "objects": TOP_ROW_OBJECTS}


class Chosen(NamedTuple):
    """Rows of the table, in the order of their scenes."""

    successes: list[Row]
    failures: list[Row]

    @property
    def rows(self) -> list[Row]:
        """All of them, successes first."""
        return [*self.successes, *self.failures]


def choose(rows: Sequence[Row], task: str, criterion: str) -> Chosen:
    """The `EACH` successes and failures of a task with the lowest scene seeds, of CAVIN with the paper's planner.

    Sparse reward and 3 objects; fewer, if there are no more.
    """
    wanted = {**CHOSEN, "task": task}
    own = [row for row in rows if all(row[name] == value for name, value in wanted.items())]
    own.sort(key=lambda row: (row["seed"], row["training_seed"]))
    won = [row for row in own if row[f"{criterion}_outcome"] == "success"]
    lost = [row for row in own if row[f"{criterion}_outcome"] != "success"]
    return Chosen(won[:EACH], lost[:EACH])


def caption(row: Row, criterion: str) -> str:
    """Scene, outcome, pushes and, of a failure, its reason."""
    steps, kind = row[f"{criterion}_steps"], kind_of(row, criterion)
    scene = f"scene {row['seed']}, training {row['training_seed']}"
    pushes = f"{steps} push" if steps == 1 else f"{steps} pushes"
    predicted = f"{row['plans_reaching_goal']} of {row['plans']} plans expected success"
    reason = {
        "success": f"success after {pushes}",
        "violation": f"failure after {pushes}: a constraint was violated",
        "fall": f"failure after {pushes}: an object left the table",
    }.get(kind, f"failure: {pushes} were not enough; {predicted}")
    return f"{scene}: {reason}"
