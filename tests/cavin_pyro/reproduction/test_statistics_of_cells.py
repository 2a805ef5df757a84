from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavin_pyro.reproduction.statistics import hierarchical_interval, holm, interquartile_means, paired_tests, rates


def episodes(method: str, outcomes: dict[int, list[str]], **more: Any) -> list[dict[str, Any]]:
    """Rows of a cell, from the outcomes of each training seed."""
    return [
        {
            "method": method,
            "planner": "paper",
            "task": "crossing",
            "reward": "sparse",
            "objects": 3,
            "training_seed": training_seed,
            "seed": 1000 * training_seed + number,
            **{f"{criterion}_outcome": outcome for criterion in ("strict", "published")},
            **{f"{criterion}_{name}": 1 for criterion in ("strict", "published") for name in ("steps", "return")},
            "unsafe": 0,
            **more,
        }
        for training_seed, found in outcomes.items()
        for number, outcome in enumerate(found)
    ]


WON, LOST = "success", "timeout"


def test_a_method_that_the_paper_lacks_does_not_change_what_its_comparisons_are_corrected_for() -> None:
    ours, other = episodes("cavin", {0: [WON] * 12}), episodes("mpc", {0: [LOST] * 6 + [WON] * 6})
    more = episodes("contact", {0: [LOST] * 8 + [WON] * 4})
    without, alongside = paired_tests([*ours, *other]), paired_tests([*ours, *other, *more])
    assert [one for one in alongside if one["method"] == "mpc"] == without
    found = [one for one in alongside if one["method"] == "contact"]
    assert len(found) == 2 and all(one["p_holm"] == one["p"] for one in found)


def test_rates_pool_training_seeds_and_count_every_outcome() -> None:
    rows = episodes("cavin", {0: [WON, WON, LOST], 1: [WON, "violation", "fall"]})
    strict, published = rates(rows)
    assert (strict["criterion"], published["criterion"]) == ("strict", "published")
    assert strict["episodes"] == 6 and strict["rate"] == 0.5
    assert [strict[name] for name in ("violation", "fall", "timeout")] == pytest.approx([1 / 6] * 3)


def test_the_criteria_count_their_own_outcomes() -> None:
    rows = episodes("cavin", {0: [WON, WON]}, strict_outcome="violation")
    assert [rate["rate"] for rate in rates(rows)] == [0.0, 1.0]


def test_seeds_that_differ_widen_the_hierarchical_interval_and_not_wilsons() -> None:
    alike = {seed: [WON, LOST] * 50 for seed in range(3)}
    unlike = {0: [WON] * 100, 1: [LOST] * 100, 2: [WON, LOST] * 50}
    (one, _), (other, _) = (rates(episodes("cavin", outcomes)) for outcomes in (alike, unlike))
    assert one["rate"] == other["rate"] == 0.5 and one["low"] == other["low"]
    assert one["seed_high"] - one["seed_low"] < 0.15
    assert other["seed_high"] - other["seed_low"] > 0.5


def test_the_hierarchical_interval_of_one_seed_is_the_bootstrap_of_its_episodes() -> None:
    success = [True] * 30 + [False] * 70
    low, high = hierarchical_interval(success, [4] * 100)
    spread = 1.96 * np.sqrt(0.3 * 0.7 / 100)
    assert (low, high) == pytest.approx((0.3 - spread, 0.3 + spread), abs=0.02)
    assert hierarchical_interval(success, [4] * 100) == (low, high)


def test_methods_are_compared_scene_by_scene() -> None:
    ours = episodes("cavin", {0: [WON] * 12 + [LOST, WON]})
    theirs = episodes("mpc", {0: [LOST] * 12 + [WON, WON]})
    (found,) = (one for one in paired_tests([*ours, *theirs]) if one["criterion"] == "strict")
    assert (found["scenes"], found["reference_alone"], found["other_alone"]) == (14, 12, 1)
    assert found["difference"] == pytest.approx(11 / 14)
    # Of 13 fair coins at most one the other way, both tails.
    assert found["p"] == found["p_holm"] == pytest.approx(2 * 14 / 2**13)


def test_a_variant_is_compared_with_the_papers_planner_of_its_own_method() -> None:
    paper = episodes("sectar", {0: [WON] * 3})
    variant = episodes("sectar", {0: [LOST, WON, LOST]}, planner="perturbed_rollouts")
    (found,) = (one for one in paired_tests([*paper, *variant]) if one["criterion"] == "strict")
    assert (found["planner"], found["against"]) == ("perturbed_rollouts", "sectar-paper")
    assert (found["reference_alone"], found["other_alone"]) == (2, 0)


def test_equal_methods_are_not_told_apart() -> None:
    rows = [*episodes("cavin", {0: [WON, LOST] * 20}), *episodes("mpc", {0: [LOST, WON] * 20})]
    assert {one["p"] for one in paired_tests(rows)} == {1.0}


def test_holms_correction_of_an_example() -> None:
    """Multiplied by 4, 3, 2, 1 in the order of size, and never falling."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])


@given(st.lists(st.floats(0, 1), max_size=20))
def test_holms_correction_lies_between_none_and_bonferronis(p_values: list[float]) -> None:
    corrected = holm(p_values)
    for p, one in zip(p_values, corrected, strict=True):
        assert p <= one <= min(1.0, len(p_values) * p) or one == pytest.approx(p)
    order = np.argsort(p_values)
    assert (np.diff(np.array(corrected)[order]) >= 0).all()


def test_the_interquartile_mean_leaves_out_the_best_and_the_worst_quarter() -> None:
    rates_of_seeds = {0: [LOST] * 10, 1: [WON] * 4 + [LOST] * 6, 2: [WON] * 6 + [LOST] * 4, 3: [WON] * 10}
    strict, _ = interquartile_means(episodes("cavin", rates_of_seeds))
    assert strict["runs"] == 4 and strict["interquartile_mean"] == pytest.approx(0.5)
    worse, _ = interquartile_means(episodes("cavin", {**rates_of_seeds, 2: [LOST] * 10}))
    assert worse["interquartile_mean"] == pytest.approx(0.2)
