from __future__ import annotations

from typing import Any

from cavin_pyro.evaluation.success.probability import NO_PROBABILITY, Regression, Unfitted
from cavin_pyro.evaluation.success.sentences import calibration_of, record, sentence, sentence_of_episode

FITTED: Any = Regression("mine", {}, "", (), 0.0, {}, -1.0, 1.0, 10, 5, 100)
ROWS = [
    {"outcome": "success", "success_probability": [0.8, 0.9, 1.0]},
    {"outcome": "timeout", "success_probability": [0.3]},
    {"outcome": "timeout", "success_probability": None},
    {"outcome": "timeout"},
]


def test_an_evaluation_tells_how_predictions_and_outcomes_agree() -> None:
    found = calibration_of(ROWS)
    said = sentence(found, FITTED)
    assert said.startswith(
        "predicted success 60.0 %, 50.0 % of 2 episodes succeeded; calibration error 0.100 (0.000 to "
    )
    assert said.endswith("Brier score 0.053, 0.250 for the base rate")
    plain = record(found)
    assert plain is not None and plain["bins"] == {"predicted": [0.6], "observed": [0.5], "weight": [1.0]}
    assert plain["error"]["value"] == plain["bias"]["value"]


def test_an_episode_tells_what_its_plans_gave() -> None:
    assert sentence_of_episode(ROWS[0], FITTED) == "predicted success 80 % at the start, 100 % at the end"


def test_without_a_fit_the_reason_is_told_and_no_number() -> None:
    assert calibration_of(ROWS[2:]) is None is record(None)
    assert sentence(None, Unfitted("not fitted for layout=1")) == (
        "probability of success: uncalibrated, not fitted for layout=1"
    )
    assert sentence(None, NO_PROBABILITY) == "" == sentence_of_episode(ROWS[2], NO_PROBABILITY)
    assert sentence(None, FITTED) == ""  # episodes of an older version
