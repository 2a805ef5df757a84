from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from cavin_pyro.evaluation.success.predictors import SUCCESS_PREDICTORS, columns_of, plans_of, success_predictors
from cavin_pyro.evaluation.success.regressors import REGRESSORS, without_progress
from planning import RandomPlanner
from planning.plan import SuccessPredictors
from tests.cavin_pyro.visualization.test_figures import made_up_plan, state

MASK = np.arange(5) < 3


def told() -> dict[str, float]:
    plan = made_up_plan()._replace(
        success_predictors=SuccessPredictors(
            *(torch.tensor([value]) for value in (0.123456789, 0.25, math.nan, math.nan))
        ),
        expected_success=torch.tensor([True]),
    )
    found = success_predictors(plan, step=2, pushes_left=58, distance=0.5, mask=MASK)
    assert found is not None
    return dict(found)


def test_a_plan_tells_every_number_as_its_row_has_it() -> None:
    found = told()
    assert list(found) == list(SUCCESS_PREDICTORS)
    assert found["reaching"] == 0.12346 and found["reaches"] == 1 and found["objects"] == 3
    assert found["tracking"] == pytest.approx(0.0, abs=1e-6)
    columns = columns_of([found, found])
    assert columns is not None and columns["allowed_distance"] == [None, None] and columns["step"] == [2, 2]
    assert str(plans_of(columns)) == str([found, found])  # NaN differs from itself


def test_a_planner_that_predicts_nothing_tells_nothing() -> None:
    plan = RandomPlanner().plan(state(), [torch.Generator().manual_seed(0)])
    assert success_predictors(plan, step=0, pushes_left=60, distance=0.5, mask=MASK) is None
    assert columns_of([None, None]) is None is columns_of([])


def test_progress_counts_from_the_last_two_centimetres() -> None:
    ways = (0.50, 0.49, 0.47, 0.46, 0.48, 0.452)
    plans = [{**told(), "step": 3 * number, "allowed_distance": way} for number, way in enumerate(ways)]
    assert [without_progress(plans[: number + 1]) for number in range(len(plans))] == [0, 3, 0, 3, 6, 9]


def test_every_predictor_is_a_number_and_reads_only_the_past() -> None:
    first, second = (
        {**told(), "allowed_distance": 0.5, "allowed_distance_after": 0.2},
        {**told(), "allowed_distance": 0.1, "allowed_distance_after": 0.0},
    )
    for name, regressor in REGRESSORS.items():
        assert math.isfinite(regressor.value([first, second])), name
    assert REGRESSORS["metres per push left"].value([first, second]) == pytest.approx(0.1 / 58)
    assert REGRESSORS["metres per push left"].value([told()]) == pytest.approx(0.5 / 58)  # the task's distance
