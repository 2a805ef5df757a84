"""A section of the report, the result of a check: findings, values, tables and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure

from cavin_pyro.criticism.verdicts.verdict import Verdict


@dataclass(frozen=True)
class Table:
    """Numbers to read: `rows`, each with one entry per column of `header`; floats are shown with `digits`."""

    header: Sequence[str]
    rows: Sequence[Sequence[Any]]
    digits: int = 3


@dataclass(frozen=True)
class Picture:
    """A figure and its caption."""

    name: str  # file name without ending
    caption: str
    figure: Figure


@dataclass(frozen=True)
class Section:
    """One section of the report.

    Attributes:
        name: key in report.json. title: heading. explanation: the measurement, its data, and how to read it.
        findings: of this run, a sentence each, derived from the values.
        verdict: good, inspect or bad, by which rule, and what to do next.
        values: for report.json: numbers, strings, lists and dictionaries of them.
    """

    name: str
    title: str
    explanation: str
    findings: Sequence[str]
    values: Mapping[str, Any]
    tables: Sequence[Table] = field(default_factory=tuple)
    pictures: Sequence[Picture] = field(default_factory=tuple)
    verdict: Verdict | None = None
