"""Do intervals hold what they say: models that are right by construction, and models whose scales are wrong."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from scipy.stats import kstest, norm

from cavin_pyro.criticism.estimates import rank
from cavin_pyro.criticism.intervals import Prediction, assess_intervals, predict, score
from cavin_pyro.criticism.windows import seeded


@pytest.mark.parametrize("predictor", ["f", "h_prior"])
def test_predictions_of_the_right_model_are_calibrated(right: SimpleNamespace, predictor: str) -> None:
    window = right.windows[predictor[0]]
    with torch.no_grad(), seeded(4):
        one = predict(right.context(right.model, window), window, 100)[f"{predictor} centres"]
        ranks = rank(one.samples, one.real)
    assert kstest(ranks[one.counted].numpy(), "uniform").pvalue > 1e-3
    found = score(one, ranks, torch.arange(len(window.actions)))
    assert found["50"].mean == pytest.approx(0.5, abs=0.04) and found["90"].mean == pytest.approx(0.9, abs=0.03)
    assert found["stated"] == pytest.approx(found["error"], rel=0.1)


@pytest.mark.parametrize(
    "wrong, named", [({"center": 0.005}, "x and y of all objects by f"), ({"feature": 0.4}, "features by f")]
)
def test_intervals_too_narrow_or_too_wide_are_found(right: SimpleNamespace, wrong: dict, named: str) -> None:
    section = assess_intervals(right.context(right.make(**wrong), right.windows["f"]), windows=200, samples=40)
    assert section.verdict.level == "bad" and named in section.verdict.rule
    if "center" in wrong:  # of a normal with twice the stated scale
        assert section.number is not None
        assert section.number.mean == pytest.approx(2 * norm.cdf(norm.ppf(0.95) / 2) - 1, abs=0.04)


def test_scores_of_known_samples_count_what_counts() -> None:
    samples = torch.tensor([[[0.0, 9.0]], [[2.0, 9.0]]]).repeat(1, 3, 1)
    counted = torch.tensor([[True, False]] * 3)
    found = score(Prediction(samples, torch.ones(3, 2), counted), torch.full((3, 2), 0.5), torch.arange(3))
    assert found["90"].mean == 1.0 and found["stated"] == pytest.approx(2**0.5) and found["error"] == 0.0


def test_all_parts_of_a_cascade_are_covered_and_repeatable(right: SimpleNamespace) -> None:
    context = right.context(right.model, right.windows["h"])
    section = assess_intervals(context, windows=30, samples=6)
    states = [f"{part} {what}" for part in ("f", "h_prior", "h_guide") for what in ("centres", "moved", "features")]
    assert list(section.values["predictions"]) == [*states, "g_guide pushes"]
    assert str(assess_intervals(context, windows=30, samples=6).values) == str(section.values)
    alone = assess_intervals(right.dynamics, windows=30, samples=6)
    assert list(alone.values["predictions"]) == ["f centres", "f moved", "f features"]
