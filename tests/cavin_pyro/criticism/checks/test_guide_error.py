from __future__ import annotations

import json
import math
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from cavin_pyro.criticism.checks.guide_error import assess_guide_error
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.statistics.codes import guide_density, log_weights, sample_guide
from cavin_pyro.criticism.statistics.inference.importance import evidence_bounds
from cavin_pyro.criticism.statistics.windows import seeded
from models.state import Window

FEW = {"windows": 40, "particles": (1, 10, 200), "inner_windows": 20, "inner_particles": 4}


def test_every_weight_of_the_exact_posterior_is_the_evidence(linear: SimpleNamespace) -> None:
    window = linear.windows(6)
    logs = log_weights(linear.model(), linear.guide(), window, 50, rows=100)
    assert logs.shape == (50, 6)
    torch.testing.assert_close(logs, linear.evidence(window).expand(50, 6), rtol=0, atol=1e-9)


@pytest.mark.parametrize("shift, stretch", [(1.0, 1.0), (0.0, 2.0), (0.5, 1.3)])
def test_bounds_rise_from_the_elbo_to_the_evidence(shift: float, stretch: float, linear: SimpleNamespace) -> None:
    window = linear.windows(30)
    with seeded(0):
        logs = log_weights(linear.model(), linear.guide(shift, stretch), window, 2000)
    missing = {
        K: (linear.evidence(window) - bound).mean().item() for K, bound in evidence_bounds(logs, (1, 40, 2000)).items()
    }
    divergence = 2 * (0.5 * shift**2 + 0.5 * stretch**2 - 0.5 - math.log(stretch))  # of two dimensions
    assert missing[1] == pytest.approx(divergence, abs=0.02)
    assert 0 < missing[40] < 0.3 * divergence
    assert abs(missing[2000]) < 0.02


def test_the_exact_posterior_leaves_nothing_to_gain(linear: SimpleNamespace) -> None:
    section = assess_guide_error(linear.context(linear.guide()), **FEW)
    for name in ("joint", "motion_code", "effect_code"):
        assert section.values[name]["rises"]["200"]["mean"] == pytest.approx(0.0, abs=1e-6)
        assert section.values[name]["pareto_k"]["above_limit"] == 0
    # q(c) has seen the actions: it is not p(c | x).
    assert section.values["effect_code_given_subgoal"]["rises"]["200"]["mean"] > 0.01


def test_a_guide_too_narrow_in_one_code_is_detected_in_that_code(linear: SimpleNamespace) -> None:
    section = assess_guide_error(linear.context(linear.guide(stretch=0.25)), **FEW)
    for name in ("joint", "effect_code"):
        assert section.values[name]["rises"]["200"]["mean"] > 0.5
        assert section.values[name]["pareto_k"]["above_limit"] > 0.5
    assert section.values["motion_code"]["rises"]["200"]["mean"] == pytest.approx(0.0, abs=1e-6)
    assert "k-hat is above 0.57 for 0%" in section.findings[-1]


def test_fixed_codes_are_not_sampled_and_their_densities_count(linear: SimpleNamespace) -> None:
    model, guide, window = linear.model(), linear.guide(), linear.windows(5)
    held = torch.randn(7, 5, 2, dtype=torch.float64)
    logs = log_weights(model, guide, window, 7, fixed={"effect_code": held}, rows=10)
    # With z exact, the weight is p(x, y, c) / q(c), and q is the posterior.
    torch.testing.assert_close(logs, linear.evidence(window).expand(7, 5), rtol=0, atol=1e-9)
    density = guide_density(guide, window, {"effect_code": held}, "effect_code", rows=10)
    mean = sample_guide(guide, window, 20_000)["effect_code"].mean(0)
    expected = torch.distributions.Normal(mean, linear.effect_precision**-0.5).log_prob(held).sum(-1)
    torch.testing.assert_close(density, expected, rtol=0, atol=0.3)


def test_one_code_is_judged_as_a_whole_and_none_with_a_sentence(linear: SimpleNamespace) -> None:
    assert set(assess_guide_error(linear.one_code(), **FEW).values) == {"joint"}
    empty = assess_guide_error(linear.no_code(), **FEW)
    assert "no codes" in empty.findings[0]
    assert not empty.pictures


def test_the_section_is_repeatable_and_fits_json(cascade: CheckContext) -> None:
    sections = [assess_guide_error(cascade, windows=8, particles=(1, 50), inner_windows=4) for _ in range(2)]
    first, second = (json.dumps(section.values, allow_nan=False) for section in sections)
    assert first == second
    assert [picture.name for picture in sections[0].pictures] == ["guide_error"]


def weights(context: CheckContext, window: Window) -> Tensor:
    with seeded(0):
        return log_weights(context.model, context.guide, window, 20)


def test_neither_the_order_of_objects_nor_padding_changes_a_weight(cascade: CheckContext) -> None:
    window, states = cascade.validation, cascade.validation.states
    order = torch.tensor([3, 0, 4, 1, 2])
    shuffled = window._replace(
        states=type(states)(states.centers[:, :, order], states.features[:, :, order], states.mask[..., order])
    )
    padding = ~states.mask.unsqueeze(-1)
    spoilt = window._replace(
        states=states._replace(
            centers=states.centers.masked_fill(padding, 7.0), features=states.features.masked_fill(padding, 0.125)
        )
    )
    expected = weights(cascade, window)
    for other in (shuffled, spoilt):
        torch.testing.assert_close(weights(cascade, other), expected, rtol=1e-9, atol=1e-9)
