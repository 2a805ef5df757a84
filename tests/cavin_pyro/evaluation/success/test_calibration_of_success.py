"""The calibration error tells calibrated predictions from others, with intervals over episodes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit, logit

from cavin_pyro.evaluation.success.calibration import Calibration, calibration

PREDICTED = (0.3, 0.7, 0.9)


def episodes(count: int, *, seed: int = 0, sharpness: float = 1.0) -> tuple[list[list[float]], list[bool]]:
    """Episodes whose probability of success is told in each of their plans, with log odds times `sharpness`."""
    generator = np.random.default_rng(seed)
    chances = generator.choice(PREDICTED, size=count)
    told = expit(sharpness * logit(chances))
    plans = generator.integers(1, 30, size=count)
    return [[one] * many for one, many in zip(told, plans, strict=True)], list(generator.random(count) < chances)


def test_calibrated_predictions_pass() -> None:
    found = calibration(*episodes(3000))
    assert found.error.value < 0.025 and found.error.low == 0.0
    assert found.debiased.value < 0.02 and found.debiased.high < 0.05
    assert found.bias.low < 0.0 < found.bias.high


@pytest.mark.parametrize("sharpness", [4.0, 0.2])
def test_predictions_that_are_too_sure_or_too_unsure_fail(sharpness: float) -> None:
    found = calibration(*episodes(600, sharpness=sharpness))
    assert found.error.low > 0.05 and found.debiased.low > 0.05


def test_few_episodes_do_not_show_that_predictions_are_calibrated() -> None:
    assert calibration(*episodes(20)).error.high > 0.05


def test_many_plans_of_an_episode_are_no_more_evidence_than_one() -> None:
    told, ends = episodes(120)
    first = [one[:1] for one in told]
    assert calibration(told, ends).error == pytest.approx(calibration(first, ends).error)


def test_every_episode_counts_the_same() -> None:
    found = calibration([[0.9], [0.9] * 99], [True, False])
    assert found.brier == pytest.approx((0.01 + 0.81) / 2)
    assert found.bias.value == pytest.approx(0.4) == found.error.value


def test_the_brier_score_is_the_sum_of_its_parts_and_the_base_rate_has_no_skill() -> None:
    found = calibration(*episodes(900))
    total = found.reliability - found.resolution + found.base + found.within
    assert found.brier == pytest.approx(total)
    assert abs(found.within) < 0.01 and found.resolution > 0.02 and found.skill > 0.1
    ends = episodes(900)[1]
    assert calibration([[float(np.mean(ends))]] * 900, ends).skill == pytest.approx(0.0)


@pytest.mark.soak
def test_the_interval_holds_the_error_of_many_more_episodes() -> None:
    truth = calibration(*episodes(30_000, sharpness=2.0)).error.value
    found: list[Calibration] = [calibration(*episodes(150, seed=seed, sharpness=2.0)) for seed in range(40)]
    assert sum(one.error.low <= truth <= one.error.high for one in found) >= 34


def test_bins_have_enough_episodes() -> None:
    assert [len(calibration([[p] for p in np.linspace(0, 1, n)], [True] * n).weight) for n in (10, 75, 900)] == [
        *(1, 3, 10)
    ]


REFUSED: list[tuple[list[list[float]], list[bool]]] = [
    ([], []),
    ([[0.5]], [True, False]),
    ([[]], [True]),
    ([[1.2]], [True]),
    ([[float("nan")]], [True]),
]


@pytest.mark.parametrize(("told", "ends"), REFUSED)
def test_what_cannot_be_compared_is_refused(told: list[list[float]], ends: list[bool]) -> None:
    with pytest.raises(ValueError, match=r"calibration needs|probabilities must"):
        calibration(told, ends)
