"""Verdicts of sections: good, inspect or bad, by a rule that is printed with them; a warning where too little was seen.

A verdict rests on the size of an effect and its interval over episodes, never on a large p: a test that finds nothing
may have been too weak.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from torch import Tensor

GOOD, INSPECT, BAD = "good", "inspect", "bad"
FEW = "too few"  # windows or episodes for a conclusion
NONE = "none"  # nothing of the kind in this model
SEVERITY = (NONE, GOOD, INSPECT, BAD)
RENAMED = {"look": INSPECT}  # in reports of older versions: old level, new level
MINIMUM_WINDOWS = 100
MINIMUM_EPISODES = 50


@dataclass(frozen=True)
class Verdict:
    """What a section concludes.

    Attributes:
        level: good, inspect, bad, too few or none. rule: how it came about. advice: what to do next.
    """

    level: str
    rule: str
    advice: str = ""


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


def conclude(level: str, rule: str, advice: str, *, windows: int, episodes: Tensor | int) -> Verdict:
    """A verdict, or a warning in its place if there were too few windows or episodes `[B]` (or their number)."""
    count = episodes if isinstance(episodes, int) else len(episodes.unique())
    if windows < MINIMUM_WINDOWS or count < MINIMUM_EPISODES:
        return Verdict(
            FEW,
            f"Only {windows} windows of {count} episodes: a conclusion needs at least {MINIMUM_WINDOWS} of "
            f"{MINIMUM_EPISODES}. ({rule})",
            "Check with more windows, or with more held-out data (windows=, data=).",
        )
    return Verdict(level, rule, advice if level != GOOD else "")
