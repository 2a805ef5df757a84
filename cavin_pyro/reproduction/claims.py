"""The paper's claims about its figure (section 5, "Task performance" and "Varying number of objects"), checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd
from statsmodels.stats.proportion import confint_proportions_2indep

from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.reproduction.sizes import REWARDS, TASKS, TOP_ROW_OBJECTS
from cavin_pyro.reproduction.statistics import REFERENCE

LEADS = {  # points between CAVIN and the second best, 3 objects
    "sparse": {"clearing": 20.1, "insertion": 14.6, "crossing": 11.1},
    "dense": {"clearing": 10.0, "insertion": 11.7, "crossing": 13.9},
}
LOSS_TO_SPARSE = 5.0  # points that CAVIN loses at most from dense to sparse rewards
LOSS_TO_FIVE = 9.4  # points that CAVIN loses in clearing from 1 to 5 objects
BASELINES_LOSS_TO_FIVE = "51.1, 53.3 and 70.2"  # of the baselines; the paper does not say which is whose
Claim = dict[str, str]
Rate = Mapping[str, Any]


def difference(one: Rate, other: Rate) -> tuple[float, float, float]:
    """Points between two rates and their 95 % interval, from Wilson's intervals of both (Newcombe 1998, method 10).

    The episodes are taken for independent; shared scenes make the interval wider than it need be.
    """
    counts = (one["successes"], one["episodes"], other["successes"], other["episodes"])
    low, high = confint_proportions_2indep(*counts, method="newcomb", compare="diff")
    return 100 * (one["rate"] - other["rate"]), 100 * low, 100 * high


def claims(rates: pd.DataFrame, tests: pd.DataFrame, *, planner: str, criterion: str) -> list[Claim]:
    """Of one kind of planner and one criterion; those whose cells were not measured are left out.

    `rates`: `cavin_pyro.reproduction.table.rates`. `tests`: `paired_tests`. Returns for each its `claim`, what stands
    in the paper, what was measured `here`, and whether it `holds`: "yes" or "no", with ", within chance" where the
    interval includes the opposite; empty for figures alone.
    """
    place = ["method", "task", "reward", "objects"]
    own, compared = (
        table[(table["planner"] == planner) & (table["criterion"] == criterion)].set_index(place)
        for table in (rates, tests)
    )
    cells = own.to_dict("index")
    return [*_leads(cells, compared["p_holm"].to_dict()), *_losses(cells)]


def _leads(cells: Mapping[Any, Rate], p_values: Mapping[Any, float]) -> Iterator[Claim]:
    for reward, paper in LEADS.items():
        for task, points in paper.items():
            places = {name: (name, task, reward, TOP_ROW_OBJECTS) for name in METHODS if METHODS[name].in_paper}
            present = {name: cells[place] for name, place in places.items() if place in cells}
            others = [name for name in present if name != REFERENCE and REFERENCE in present]
            second = max(others, key=lambda name: present[name]["rate"], default=None)
            for name in others:
                lead, low, high = difference(present[REFERENCE], present[name])
                p = p_values[places[name]]
                yield {
                    "claim": f"{task}, {reward}: CAVIN leads {METHODS[name].label}",
                    "the paper": f"second best: {points:.1f}" if name == second else "",
                    "here": f"{lead:+.1f} ({low:.1f} to {high:.1f}), p = {p:.2g}",
                    "holds": _verdict(lead > 0, p < 0.05 and (low > 0 or high < 0)),
                }


def _losses(cells: Mapping[Any, Rate]) -> Iterator[Claim]:
    compared: list[Any] = []
    for task in TASKS:
        text = f"{task}: CAVIN loses little from dense to sparse rewards"
        compared.append((text, LOSS_TO_SPARSE, *((REFERENCE, task, reward, TOP_ROW_OBJECTS) for reward in REWARDS)))
    for name in (name for name, method in METHODS.items() if method.in_paper):
        little, most = ("little ", LOSS_TO_FIVE) if name == REFERENCE else ("", None)
        text = f"clearing: {METHODS[name].label} loses {little}from 1 to 5 objects"
        compared.append((text, most, *((name, "clearing", "sparse", objects) for objects in (1, 5))))
    for text, most, before, after in compared:
        if before in cells and after in cells:
            loss, low, high = difference(cells[before], cells[after])
            yield {
                "claim": text,
                "the paper": BASELINES_LOSS_TO_FIVE if most is None else f"less than {most:.1f}",
                "here": f"{loss:.1f} ({low:.1f} to {high:.1f})",
                "holds": "" if most is None else _verdict(loss < most, high < most or low >= most),
            }


def _verdict(holds: bool, sure: bool) -> str:
    return ("yes" if holds else "no") + ("" if sure else ", within chance")
