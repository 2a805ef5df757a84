from __future__ import annotations

import json
import math
from types import SimpleNamespace

import pytest
import torch

from cavin_pyro.criticism.checks.codes import assess_codes
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.statistics.inference.information import (
    Information,
    conditional_bounds,
    dimension_kl,
    marginal_bounds,
    posterior_mean_variance,
)

MANY = {"windows": 1000, "samples": 64, "pairs": 300}


def test_a_guide_that_ignores_its_input_carries_nothing(linear: SimpleNamespace) -> None:
    section = assess_codes(linear.context(linear.blind(), batch=1000), **MANY)
    for name in ("effect_code", "motion_code"):
        found = section.values[name]
        assert found["active"] == 0
        assert found["kl"]["mean"] == pytest.approx(0.0, abs=1e-9)
        assert found["information"]["lower"] == pytest.approx(0.0, abs=1e-9)
        assert found["information"]["upper"] == pytest.approx(0.0, abs=1e-9)


def test_a_shift_that_is_the_same_for_all_windows_costs_nats_and_carries_none(linear: SimpleNamespace) -> None:
    found = assess_codes(linear.context(linear.blind(1.0), batch=1000), **MANY).values["effect_code"]
    assert found["active"] == 0
    assert found["kl_by_dimension"] == pytest.approx([0.5, 0.5])
    assert found["aggregate_kl"]["low"] == pytest.approx(1.0)
    assert found["aggregate_kl"]["high"] == pytest.approx(1.0)


def test_the_posterior_carries_what_theory_gives(linear: SimpleNamespace) -> None:
    found = assess_codes(linear.context(linear.guide(), batch=1000), **MANY).values["effect_code"]
    information = math.log(linear.effect_precision)  # half a logarithm for each of two dimensions
    assert found["active"] == 2
    assert found["mean_variance"] == pytest.approx([1 - 1 / linear.effect_precision] * 2, rel=0.15)
    # The posterior of the true model is spread as the prior: all of the KL is information.
    assert found["kl"]["mean"] == pytest.approx(information, abs=4 * found["kl"]["standard_error"])
    bounds = found["information"]
    assert bounds["lower"] - 3 * bounds["lower_error"] < information < bounds["upper"] + 3 * bounds["upper_error"]
    assert bounds["upper"] - bounds["lower"] < 0.2


def test_the_lower_bound_stays_below_the_logarithm_of_the_number_of_windows(cascade: CheckContext) -> None:
    section = assess_codes(cascade, windows=10, samples=8, pairs=6)
    assert set(section.values) == {"effect_code", "motion_code", "windows"}
    for name in cascade.codes:
        assert section.values[name]["information"]["lower"] <= math.log(6) + 1e-9
    json.dumps(section.values, allow_nan=False)


def test_the_noise_of_few_samples_does_not_make_a_dimension_active() -> None:
    noise = torch.randn(8, 4000, 3, generator=torch.Generator().manual_seed(0))
    assert posterior_mean_variance(noise).abs().max() < 0.02
    spread = torch.linspace(-1, 1, 4000)[:, None] * torch.tensor([0.0, 1.0, 2.0])
    expected = torch.tensor([0.0, 1 / 3, 4 / 3])
    torch.testing.assert_close(posterior_mean_variance(noise + spread), expected, rtol=0.1, atol=0.02)


def test_dimensions_sum_to_the_kl_of_the_whole_code(cascade: CheckContext) -> None:
    found = dimension_kl(cascade.model, cascade.guide, cascade.validation)
    q = cascade.guide.effect_inference(cascade.validation.first, cascade.validation.last)
    p = cascade.model.effect_prior(cascade.validation.first)
    whole = torch.distributions.kl_divergence(q.base_dist, p.base_dist).sum(-1)
    torch.testing.assert_close(found["effect_code"].sum(-1), whole)


def test_one_code_has_one_row_and_none_a_sentence(linear: SimpleNamespace) -> None:
    assert len(assess_codes(linear.one_code(), windows=50, samples=8, pairs=20).tables[0].rows) == 1
    assert "no codes" in assess_codes(linear.no_code()).findings[0]


def test_bounds_hold_for_a_prior_that_depends_on_the_state(scenes: SimpleNamespace) -> None:
    """c tells s and nothing of s': by the rate less I(c; s, s'), a divergence would be some -2 nats."""
    found = assess_codes(scenes.context(scenes.guide(blind=True)), windows=600, pairs=200).values["effect_code"]
    assert found["information"]["lower"] > 1.5
    assert found["prior_varies"] and found["aggregate_kl"] is None
    assert found["information_given_state"] == {"low": None, "high": pytest.approx(0.0, abs=1e-6)}
    assert found["aggregate_kl_given_state"]["high"] == pytest.approx(0.0, abs=1e-6)


def test_nats_that_only_separate_the_aggregate_from_the_prior_are_no_information(scenes: SimpleNamespace) -> None:
    found = assess_codes(scenes.context(scenes.guide(blind=True, shift=1.0)), windows=600, pairs=50).values[
        "effect_code"
    ]
    assert found["kl"]["mean"] == pytest.approx(1.5)
    assert (
        0.7
        < found["aggregate_kl_given_state"]["low"]
        <= 1.5
        == pytest.approx(found["aggregate_kl_given_state"]["high"])
    )
    assert found["information_given_state"]["high"] < 0.8


def test_the_posterior_carries_at_most_its_rate(scenes: SimpleNamespace) -> None:
    found = assess_codes(scenes.context(scenes.guide()), windows=600, pairs=50).values["effect_code"]
    information = 1.5 * math.log(1 + scenes.precision)
    assert found["information_given_state"]["high"] == pytest.approx(information, abs=0.2)
    assert found["aggregate_kl_given_state"]["low"] < 0.1


def test_a_number_that_is_no_bound_is_refused() -> None:
    between = Information(1.0, 2.0, 0.0, 0.0)
    assert marginal_bounds(3.0, between, varies=False) == (1.0, 2.0)
    with pytest.raises(ValueError, match="bounds no divergence when the prior depends on the state"):
        marginal_bounds(3.0, between, varies=True)
    assert conditional_bounds(3.0, -1.0) == ((None, 3.0), (0.0, 3.0))
    assert conditional_bounds(3.0, 1.0) == ((None, 2.0), (1.0, 3.0))
