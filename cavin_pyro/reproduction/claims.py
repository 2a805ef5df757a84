"""The paper's claims about its figure (section 5, "Task performance" and "Varying number of objects"), checked."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from cavin_pyro.reproduction.methods import METHODS, PAPER_METHODS
from cavin_pyro.reproduction.scales import TOP_ROW_OBJECTS

LEADS = {  # points between CAVIN and the second best, 3 objects
    "sparse": {"clearing": 20.1, "insertion": 14.6, "crossing": 11.1},
    "dense": {"clearing": 10.0, "insertion": 11.7, "crossing": 13.9},
}
LOSS_TO_SPARSE = 5.0  # points that CAVIN loses at most from dense to sparse rewards
LOSS_TO_FIVE = 9.4  # points that CAVIN loses in clearing from 1 to 5 objects
BASELINES_LOSS_TO_FIVE = "51.1, 53.3 and 70.2"  # of the baselines; the paper does not say which is whose
OURS = "cavin"
Rate = Mapping[str, Any]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper's, what was measured, and whether that agrees.

    holds: "yes" or "no", with ", within chance" where the interval includes the opposite; empty for figures alone.
    """

    text: str
    paper: str
    measured: str
    holds: str


def difference(one: Rate, other: Rate) -> tuple[float, float, float]:
    """Points between two rates and their 95 % interval, from Wilson's intervals of both (Newcombe 1998, method 10).

    The episodes are taken for independent; shared scenes make the interval wider than it need be.
    """
    points = one["rate"] - other["rate"]
    below = math.hypot(one["rate"] - one["low"], other["high"] - other["rate"])
    above = math.hypot(one["high"] - one["rate"], other["rate"] - other["low"])
    return 100 * points, 100 * (points - below), 100 * (points + above)


def claims(
    measured: Sequence[Rate], compared: Sequence[Mapping[str, Any]], *, planner: str, criterion: str
) -> list[Claim]:
    """Of one kind of planner and one criterion; those whose cells were not measured are left out.

    Args:
        measured: `cavin_pyro.reproduction.statistics.rates`. compared: `paired_tests`.
    """
    cells = {
        (one["method"], one["task"], one["reward"], one["objects"]): one
        for one in measured
        if one["planner"] == planner and one["criterion"] == criterion
    }
    p_values = {
        (one["method"], one["task"], one["reward"], one["objects"]): one["p_holm"]
        for one in compared
        if one["planner"] == planner and one["criterion"] == criterion
    }
    return [*_leads(cells, p_values), *_to_sparse(cells), *_to_five(cells)]


def section(found: Sequence[Claim], planner: str, criterion: str) -> list[str]:
    """Lines of the page of results; none without claims."""
    if not found:
        return []
    return [
        f"## The paper's claims, planner `{planner}`, criterion {criterion}",
        "",
        "Differences in points, with 95 % intervals (Newcombe's method 10). A lead is within chance unless its whole",
        "interval is above 0 and p is below 0.05; a loss is, unless its whole interval is on one side of the paper's.",
        "",
        "| claim | the paper | here | holds |",
        "| --- | --- | --- | --- |",
        *(f"| {one.text} | {one.paper} | {one.measured} | {one.holds} |" for one in found),
        "",
    ]


def _leads(cells: Mapping[tuple[Any, ...], Rate], p_values: Mapping[tuple[Any, ...], float]) -> Iterator[Claim]:
    for reward, paper in LEADS.items():
        for task, points in paper.items():
            own = cells.get((OURS, task, reward, TOP_ROW_OBJECTS))
            others = {name: (name, task, reward, TOP_ROW_OBJECTS) for name in PAPER_METHODS if name != OURS}
            present = [name for name, place in others.items() if place in cells]
            if own is None or not present:
                continue
            second = max(present, key=lambda name: cells[others[name]]["rate"])
            for name in present:
                lead, low, high = difference(own, cells[others[name]])
                p = p_values[others[name]]
                yield Claim(
                    f"{task}, {reward}: CAVIN leads {METHODS[name].label}",
                    f"second best: {points:.1f}" if name == second else "",
                    f"{lead:+.1f} ({low:.1f} to {high:.1f}), p = {p:.2g}",
                    _verdict(lead > 0, p < 0.05 and (low > 0 or high < 0)),
                )


def _to_sparse(cells: Mapping[tuple[Any, ...], Rate]) -> Iterator[Claim]:
    for task in LEADS["sparse"]:
        dense, sparse = (cells.get((OURS, task, reward, TOP_ROW_OBJECTS)) for reward in ("dense", "sparse"))
        if dense is not None and sparse is not None:
            yield _loss(f"{task}: CAVIN loses little from dense to sparse rewards", dense, sparse, LOSS_TO_SPARSE)


def _to_five(cells: Mapping[tuple[Any, ...], Rate]) -> Iterator[Claim]:
    for name in PAPER_METHODS:
        one, five = (cells.get((name, "clearing", "sparse", objects)) for objects in (1, 5))
        if one is None or five is None:
            continue
        if name == OURS:
            yield _loss("clearing: CAVIN loses little from 1 to 5 objects", one, five, LOSS_TO_FIVE)
        else:
            loss, low, high = difference(one, five)
            text = f"clearing: {METHODS[name].label} loses from 1 to 5 objects"
            yield Claim(text, BASELINES_LOSS_TO_FIVE, f"{loss:.1f} ({low:.1f} to {high:.1f})", "")


def _loss(text: str, before: Rate, after: Rate, most: float) -> Claim:
    loss, low, high = difference(before, after)
    holds = _verdict(loss < most, high < most or low >= most)
    return Claim(text, f"less than {most:.1f}", f"{loss:.1f} ({low:.1f} to {high:.1f})", holds)


def _verdict(holds: bool, sure: bool) -> str:
    return ("yes" if holds else "no") + ("" if sure else ", within chance")
