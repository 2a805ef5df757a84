"""A section of the report: a question, one number with its interval, one figure and one verdict.

A verdict is good, inspect or bad by a rule that is printed with it. It rests on the size of an effect and its interval
over episodes, never on a large p: a test that finds nothing may have been too weak.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure
from torch import Tensor

from cavin_pyro.criticism.estimates import Interval

GOOD, INSPECT, BAD = "good", "inspect", "bad"
FEW = "too few"  # windows or episodes for a conclusion
NONE = "none"  # nothing of the kind in this model
SEVERITY = (NONE, GOOD, INSPECT, BAD)
MINIMUM_WINDOWS = 100
MINIMUM_EPISODES = 50


@dataclass(frozen=True)
class Verdict:
    """What a section concludes.

    `level`: good, inspect, bad, too few or none. `rule`: how it came about. `advice`: what to do next.
    """

    level: str
    rule: str
    advice: str = ""


@dataclass(frozen=True)
class Section:
    """One section of the report.

    Attributes:
        explanation: the measurement, its data, and how to read it.
        verdict: good, inspect or bad, by which rule, and what to do next.
        findings: of this run, a sentence each, derived from the values.
        values: for report.json: numbers, strings, intervals, lists and dictionaries of them.
        measure: what `number` is, with its unit. number: the estimate that answers the question.
        figure, caption: drawn in the report.
    """

    explanation: str
    verdict: Verdict
    findings: Sequence[str] = ()
    values: Mapping[str, Any] = field(default_factory=dict)
    measure: str = ""
    number: Interval | None = None
    figure: Figure | None = None
    caption: str = ""


def not_applicable(reason: str) -> Section:
    """The section of a model that has nothing of the kind."""
    return Section("", Verdict(NONE, reason), [reason])


def grade(low: float, high: float, *, good: float, bad: float) -> str:
    """Of an effect that should be small, with the ends of its interval.

    good: even the upper end is at most `good`. bad: even the lower end is at least `bad`. inspect: all between, and
    what is not known.
    """
    return GOOD if high <= good else BAD if low >= bad else INSPECT


def within(low: float, high: float, *, good: tuple[float, float], bad: tuple[float, float]) -> str:
    """Of a number that should lie within a range, with the ends of its interval.

    good: the whole interval lies in `good`. bad: the whole interval lies on one side of `bad`, outside of it.
    """
    if low >= good[0] and high <= good[1]:
        return GOOD
    return BAD if high < bad[0] or low > bad[1] else INSPECT


def worst(levels: Iterable[str]) -> str:
    """The most severe of several levels."""
    return max(levels, key=SEVERITY.index, default=NONE)


def conclude(level: str, rule: str, advice: str, episodes: Tensor) -> Verdict:
    """A verdict, or a warning in its place if there were too few windows, of `episodes: [B]`."""
    windows, count = len(episodes), len(episodes.unique())
    if windows < MINIMUM_WINDOWS or count < MINIMUM_EPISODES:
        rule = (
            f"Only {windows} windows of {count} episodes: a conclusion needs at least {MINIMUM_WINDOWS} of "
            f"{MINIMUM_EPISODES}. ({rule})"
        )
        return Verdict(FEW, rule, "Check with more windows, or with more held-out data (windows=, data=).")
    return Verdict(level, rule, advice if level != GOOD else "")
