from __future__ import annotations

from typing import Any

import pytest

from cavin_pyro.evaluation.statistics import wilson
from cavin_pyro.reproduction.claims import claims, difference, section


def cell(method: str, successes: int, trials: int, **place: Any) -> dict[str, Any]:
    where = {"task": "clearing", "reward": "sparse", "objects": 3, "planner": "paper", "criterion": "strict", **place}
    return {"method": method, **where, **wilson(successes, trials)}


def found(cells: list[dict[str, Any]], p: float = 0.001) -> dict[str, tuple[str, str]]:
    compared = [{**one, "p_holm": p} for one in cells if one["method"] != "cavin"]
    return {one.text: (one.paper, one.holds) for one in claims(cells, compared, planner="paper", criterion="strict")}


def test_a_difference_has_the_interval_that_newcombe_published() -> None:
    # Newcombe (1998), table II, comparison (a), method 10: 56 of 70 against 48 of 80.
    points, low, high = difference(wilson(56, 70), wilson(48, 80))
    assert (points, low, high) == pytest.approx((20.0, 5.24, 33.39), abs=0.01)


def test_a_lead_holds_only_beyond_the_interval_and_by_the_test() -> None:
    lead = "clearing, sparse: CAVIN leads MPC"
    assert found([cell("cavin", 95, 100), cell("mpc", 20, 100)])[lead] == ("second best: 20.1", "yes")
    assert found([cell("cavin", 95, 100), cell("mpc", 20, 100)], p=0.2)[lead][1] == "yes, within chance"
    assert found([cell("cavin", 10, 10), cell("mpc", 9, 10)])[lead][1] == "yes, within chance"
    assert found([cell("cavin", 20, 100), cell("mpc", 95, 100)])[lead][1] == "no"
    assert found([cell("cavin", 9, 10), cell("mpc", 9, 10)])[lead][1] == "no, within chance"


def test_our_networks_are_no_second_best_of_the_paper() -> None:
    cells = [cell("cavin", 95, 100), cell("mpc", 20, 100), cell("contact", 99, 100)]
    assert list(found(cells)) == ["clearing, sparse: CAVIN leads MPC"]


def test_the_papers_margin_stands_beside_the_second_best_alone() -> None:
    cells = [cell("cavin", 95, 100), cell("mpc", 20, 100), cell("sectar", 70, 100), cell("cvae_mpc", 50, 100)]
    papers = {text.split()[-1]: paper for text, (paper, _) in found(cells).items()}
    assert papers == {"SeCTAR": "second best: 20.1", "CVAE-MPC": "", "MPC": ""}


@pytest.mark.parametrize(
    ("dense", "sparse", "holds"),
    [(990, 985, "yes"), (99, 98, "yes, within chance"), (99, 92, "no, within chance"), (99, 60, "no")],
)
def test_a_loss_to_sparse_rewards_is_held_against_five_points(dense: int, sparse: int, holds: str) -> None:
    trials = 1000 if dense > 100 else 100
    cells = [cell("cavin", dense, trials, reward="dense"), cell("cavin", sparse, trials)]
    assert found(cells) == {"clearing: CAVIN loses little from dense to sparse rewards": ("less than 5.0", holds)}


def test_a_loss_to_five_objects_is_judged_for_cavin_and_told_of_the_others() -> None:
    cells = [
        cell(name, count, 100, objects=objects) for name in ("cavin", "mpc") for objects, count in ((1, 95), (5, 40))
    ]
    assert found(cells) == {
        "clearing: CAVIN loses little from 1 to 5 objects": ("less than 9.4", "no"),
        "clearing: MPC loses from 1 to 5 objects": ("51.1, 53.3 and 70.2", ""),
    }


def test_other_planners_and_criteria_are_not_mixed_in() -> None:
    cells = [cell("cavin", 95, 100), cell("mpc", 20, 100, planner="ours"), cell("mpc", 20, 100, criterion="published")]
    assert found(cells) == {}
    assert section([], "paper", "strict") == []
