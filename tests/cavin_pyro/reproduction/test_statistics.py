"""What is counted in a table of episodes, by hand: rates, tests, and the paper's claims."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from cavin_pyro.evaluation.statistics import wilson
from cavin_pyro.reproduction.claims import claims, difference
from cavin_pyro.reproduction.statistics import hierarchical_interval, paired_tests, rates
from cavin_pyro.reproduction.table import as_table

WON, LOST = "success", "timeout"


def episodes(method: str, outcomes: dict[int, list[str]], **more: object) -> pd.DataFrame:
    """A cell's part of a table, from the outcomes of each training seed."""
    rows = [
        {
            **{"method": method, "planner": "paper", "task": "crossing", "reward": "sparse", "objects": 3},
            **{"training_seed": training_seed, "seed": 1000 * training_seed + number},
            **{f"{criterion}_outcome": outcome for criterion in ("strict", "published")},
            **{f"{criterion}_{name}": 1 for criterion in ("strict", "published") for name in ("steps", "return")},
            **{"unsafe": 0, "ineffective": 0, "plans": 1, "plans_reaching_goal": 0, "subgoal_distance": None},
            **more,
        }
        for training_seed, found in outcomes.items()
        for number, outcome in enumerate(found)
    ]
    return as_table(rows)


def strict(table: pd.DataFrame) -> pd.DataFrame:
    return table[table["criterion"] == "strict"].reset_index(drop=True)


def test_rates_pool_training_seeds_and_criteria_count_their_own_outcomes() -> None:
    (found,) = strict(rates(episodes("cavin", {0: [WON, WON, LOST], 1: [WON, "violation", "fall"]}))).to_dict("records")
    assert (found["episodes"], found["successes"], found["rate"]) == (6, 3, 0.5)
    assert [found[name] for name in ("violation", "fall", "timeout")] == pytest.approx([1 / 6] * 3)
    both = rates(episodes("cavin", {0: [WON, WON]}, strict_outcome="violation"))
    assert dict(zip(both["criterion"], both["rate"], strict=True)) == {"strict": 0.0, "published": 1.0}


def test_the_hierarchical_interval_of_one_seed_is_the_bootstrap_of_its_episodes() -> None:
    success = np.array([True] * 30 + [False] * 70)
    low, high = hierarchical_interval(success, np.full(100, 4))
    spread = 1.96 * np.sqrt(0.3 * 0.7 / 100)
    assert (low, high) == pytest.approx((0.3 - spread, 0.3 + spread), abs=0.02)
    assert hierarchical_interval(success, np.full(100, 4)) == (low, high)


def test_methods_are_compared_scene_by_scene() -> None:
    ours = episodes("cavin", {0: [WON] * 12 + [LOST, WON]})
    theirs = episodes("mpc", {0: [LOST] * 12 + [WON, WON]})
    (found,) = strict(paired_tests(pd.concat([ours, theirs]))).to_dict("records")
    assert (found["scenes"], found["reference_alone"], found["other_alone"]) == (14, 12, 1)
    # Of 13 fair coins at most one the other way, both tails.
    assert found["p"] == found["p_holm"] == pytest.approx(2 * 14 / 2**13)


def test_equal_methods_are_not_told_apart_nor_methods_in_other_scenes_compared() -> None:
    ours = episodes("cavin", {0: [WON, LOST] * 20})
    equal = paired_tests(pd.concat([ours, episodes("mpc", {0: [LOST, WON] * 20})]))
    assert set(equal["p"]) == set(equal["p_holm"]) == {1.0}
    elsewhere = paired_tests(pd.concat([ours, episodes("mpc", {7: [LOST] * 40})]))
    assert set(elsewhere["scenes"]) == {0} and set(elsewhere["p"]) == {1.0}
    assert paired_tests(ours).empty


def test_holms_correction_multiplies_by_ranks_in_each_family() -> None:
    """Scenes that CAVIN alone solves, of 20: p is 2 / 2**scenes. Methods that the paper lacks are another family."""
    alone = {"sectar": 10, "cvae_mpc": 8, "mpc": 9, "contact": 7}
    tables = [episodes(name, {0: [LOST] * count + [WON] * (20 - count)}) for name, count in alone.items()]
    found = strict(paired_tests(pd.concat([episodes("cavin", {0: [WON] * 20}), *tables]))).set_index("method")
    assert found["p"].to_dict() == pytest.approx({name: 2 / 2**count for name, count in alone.items()})
    by_hand = {"sectar": 3 * 2 / 2**10, "mpc": 2 * 2 / 2**9, "cvae_mpc": 2 / 2**8, "contact": 2 / 2**7}
    by_hand["mpc"] = max(by_hand["mpc"], by_hand["sectar"])  # never falling
    assert found["p_holm"].to_dict() == pytest.approx(by_hand)


def test_a_difference_has_the_interval_that_newcombe_published() -> None:
    # Newcombe (1998), table II, comparison (a), method 10: 56 of 70 against 48 of 80.
    one, other = ({"successes": k, "episodes": n, **wilson(k, n)} for k, n in ((56, 70), (48, 80)))
    assert difference(one, other) == pytest.approx((20.0, 5.24, 33.39), abs=0.01)


def cell(method: str, successes: int, trials: int, **place: object) -> dict[str, object]:
    where = {"task": "clearing", "reward": "sparse", "objects": 3, "planner": "paper", "criterion": "strict", **place}
    return {"method": method, **where, "successes": successes, "episodes": trials, **wilson(successes, trials)}


def found(*cells: dict[str, object], p: float = 0.001) -> dict[str, tuple[str, str]]:
    compared = pd.DataFrame([{**one, "p_holm": p} for one in cells])
    made = claims(pd.DataFrame(cells), compared, planner="paper", criterion="strict")
    return {one["claim"]: (one["the paper"], one["holds"]) for one in made}


def test_a_lead_holds_only_beyond_the_interval_and_by_the_test() -> None:
    lead = "clearing, sparse: CAVIN leads MPC"
    assert found(cell("cavin", 95, 100), cell("mpc", 20, 100))[lead] == ("second best: 20.1", "yes")
    assert found(cell("cavin", 95, 100), cell("mpc", 20, 100), p=0.2)[lead][1] == "yes, within chance"
    assert found(cell("cavin", 10, 10), cell("mpc", 9, 10))[lead][1] == "yes, within chance"
    assert found(cell("cavin", 20, 100), cell("mpc", 95, 100))[lead][1] == "no"
    assert found(cell("cavin", 9, 10), cell("mpc", 9, 10))[lead][1] == "no, within chance"


def test_the_papers_margin_stands_beside_the_second_best_of_the_paper_alone() -> None:
    cells = [cell("cavin", 95, 100), *(cell(name, 20, 100) for name in ("mpc", "cvae_mpc"))]
    made = found(*cells, cell("sectar", 70, 100), cell("contact", 99, 100))
    papers = {text.split()[-1]: paper for text, (paper, _) in made.items()}
    assert papers == {"SeCTAR": "second best: 20.1", "CVAE-MPC": "", "MPC": ""}
    assert found(cell("cavin", 95, 100), cell("mpc", 20, 100, planner="ours")) == {}


@pytest.mark.parametrize(
    ("dense", "sparse", "trials", "holds"),
    [
        (990, 985, 1000, "yes"),
        (99, 98, 100, "yes, within chance"),
        (99, 92, 100, "no, within chance"),
        (99, 60, 100, "no"),
    ],
)
def test_a_loss_is_held_against_the_papers(dense: int, sparse: int, trials: int, holds: str) -> None:
    made = found(cell("cavin", dense, trials, reward="dense"), cell("cavin", sparse, trials))
    assert made == {"clearing: CAVIN loses little from dense to sparse rewards": ("less than 5.0", holds)}


def test_a_loss_to_five_objects_is_judged_for_cavin_and_told_of_the_others() -> None:
    few, many = {"objects": 1}, {"objects": 5}
    cells = [cell(name, *one) for name in ("cavin", "mpc") for one in ((95, 100), (40, 100))]
    placed = [{**one, **(few if number % 2 == 0 else many)} for number, one in enumerate(cells)]
    assert found(*placed) == {
        "clearing: CAVIN loses little from 1 to 5 objects": ("less than 9.4", "no"),
        "clearing: MPC loses from 1 to 5 objects": ("51.1, 53.3 and 70.2", ""),
    }
