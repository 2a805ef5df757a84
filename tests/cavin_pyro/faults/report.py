"""Outcomes of trials as a Markdown table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from tests.cavin_pyro.faults.shim import KINDS

Row = Mapping[str, Any]  # command, happened (faults as text), ends, wrong
HEAD = ("command", *KINDS, "runs with a fault", "killed", "one line", "did no harm", "wrong")


def table(rows: Iterable[Row]) -> str:
    """Faults by command and kind, how their runs ended, and in how many trials something was wrong."""
    counts: dict[str, Counter[str]] = {}
    for row in rows:
        count = counts.setdefault(row["command"], Counter())
        for fault, end in zip(row["happened"], row["ends"], strict=True):
            count[fault.partition(":")[0]] += 1
            count["runs with a fault"] += 1
            count[{"said": "one line", "survived": "did no harm"}.get(end, end)] += 1
        count["wrong"] += bool(row["wrong"])
    whole: Counter[str] = sum(counts.values(), Counter())
    lines = ["| " + " | ".join(HEAD) + " |", "| --- |" + " ---: |" * (len(HEAD) - 1)]
    for name, count in {**counts, "**all**": whole}.items():
        lines.append(f"| {name} | " + " | ".join(f"{count[column]:,}" for column in HEAD[1:]) + " |")
    return "\n".join(lines)
