"""The fit finds the probabilities that made its episodes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.special import expit

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.success.calibration import calibration
from cavin_pyro.evaluation.success.fit import by_planner, fit, logistic, read_evaluation
from cavin_pyro.evaluation.success.predictors import plans_of
from tests.cavin_pyro.evaluation.success.made_up import IF_REACHES, INTERCEPT, PER_METRE, evaluation, rows


def test_a_logistic_regression_finds_the_slopes_and_a_penalty_shortens_them() -> None:
    generator = np.random.default_rng(0)
    x = generator.normal(size=(20_000, 3)) * (1.0, 10.0, 0.1)
    y = (generator.random(20_000) < expit(0.5 + x @ (1.0, -0.1, 0.0))).astype(float)
    intercept, slopes = logistic(x, y, np.ones(20_000), 1e-6)
    assert intercept == pytest.approx(0.5, abs=0.06) and slopes == pytest.approx([1.0, -0.1, 0.0], abs=0.2)
    assert (np.abs(logistic(x, y, np.ones(20_000), 1e4)[1][:2]) < 0.6 * np.abs(slopes[:2])).all()


def test_the_mean_prediction_is_about_the_rate_of_the_weighted_episodes() -> None:
    generator = np.random.default_rng(1)
    x, weights = generator.normal(size=(500, 2)), generator.uniform(0.1, 1.0, size=500)
    y = (generator.random(500) < 0.8).astype(float)
    intercept, slopes = logistic(x, y, weights, 3.0)
    assert weights @ expit(intercept + x @ slopes) == pytest.approx(weights @ y, rel=0.01)


def test_outcomes_that_are_all_alike_are_not_given_certainty() -> None:
    intercept, slopes = logistic(np.random.default_rng(2).normal(size=(20, 2)), np.ones(20), np.ones(20), 1.0)
    assert expit(intercept) == pytest.approx(20.5 / 21, abs=0.01) and (np.abs(slopes) < 0.5).all()


def test_a_slope_does_not_get_a_sign_that_it_must_not_have() -> None:
    x = np.random.default_rng(3).normal(size=(400, 2))
    y = (x.sum(-1) > 0).astype(float)
    slopes = logistic(x, y, np.ones(400), 1.0, [-1, 1])[1]
    assert slopes[0] == 0.0 < slopes[1]


def test_a_constant_predictor_and_separable_outcomes_get_finite_slopes() -> None:
    x = np.stack([np.linspace(-1.0, 1.0, 20), np.full(20, math.log10(0.001))], -1)
    _, slopes = logistic(x, (x[:, 0] > 0).astype(float), np.full(20, 1 / 7), 1.0)
    assert slopes[0] > 1.0 and slopes[1] == 0.0


def test_a_fit_to_episodes_gives_new_ones_their_probabilities(tmp_path: Path) -> None:
    found = fit([read_evaluation(evaluation(tmp_path / "episodes", 3000))], "mine")
    told = [found(plans_of(row["success_predictors"])) for row in rows(50, seed=1)]
    truth = [
        expit(INTERCEPT + PER_METRE * columns["distance"][0] + IF_REACHES * columns["reaches"][0])
        for columns in (row["success_predictors"] for row in rows(50, seed=1))
    ]
    assert told == pytest.approx(truth, abs=0.06)
    fresh = rows(1500, seed=2)
    predicted = [[found(plans_of(row["success_predictors"])) or 0.0] for row in fresh]
    assert calibration(predicted, [row["outcome"] == "success" for row in fresh]).debiased.value < 0.03


def test_a_prediction_goes_no_farther_than_those_of_the_fit(tmp_path: Path) -> None:
    found = fit([read_evaluation(evaluation(tmp_path / "episodes", 200))], "mine")
    (plan,) = plans_of({name: values[:1] for name, values in rows(1)[0]["success_predictors"].items()})
    far = found([{**plan, "distance": 50.0}])
    assert far == pytest.approx(expit(found.lowest))


def test_each_planner_is_fitted_on_its_own_and_its_scenes_become_ranges(tmp_path: Path) -> None:
    folders = [
        evaluation(tmp_path / "a", 40),
        evaluation(tmp_path / "b", 40, "objects=5"),
        evaluation(tmp_path / "c", 40, "task=clearing"),
        evaluation(tmp_path / "d", 40, "planner.horizon=60"),
    ]
    first, second = by_planner([read_evaluation(folder) for folder in folders])
    assert [len(first), len(second)] == [3, 1]
    found = fit(first, "mine")
    assert found.episodes == 120 and second[0].situation.planner["planner.horizon"] == 60
    assert [scenes.ranges["objects"] for scenes in found.scenes] == [(3, 5), (3, 3)]


def test_episodes_that_tell_nothing_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no evaluation"):
        read_evaluation(tmp_path)
    folder = evaluation(tmp_path / "a", 5)
    older = [{name: value for name, value in row.items() if name != "success_predictors"} for row in rows(5)]
    (folder / "episodes.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in older))
    with pytest.raises(UserError, match="holds no success predictors"):
        read_evaluation(folder)
    (folder / "episodes.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows(5)))
    with pytest.raises(UserError, match="5 episodes of mine are too few for a fit: evaluate at least 10"):
        fit([read_evaluation(folder)], "mine")
