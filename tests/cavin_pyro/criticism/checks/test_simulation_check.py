from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

from cavin_pyro.criticism.checks.simulation import assess_simulation
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.statistics.inference.simulation import simulate, simulated_information
from cavin_pyro.criticism.statistics.windows import seeded


def test_the_posterior_is_calibrated_and_contracts_as_theory_says(scenes: SimpleNamespace) -> None:
    section = assess_simulation(scenes.context(scenes.guide()), samples=60)
    assert section.verdict is not None and section.verdict.level == "good", section.findings
    found = section.values["program"]
    assert found["codes"]["effect_code"]["contraction"] == pytest.approx([0.8] * 3, abs=0.03)  # 1 - 1 / (1 + 4)
    assert found["codes"]["motion_code"]["contraction"] == pytest.approx([12 / 13] * 4, abs=0.03)
    assert found["codes"]["effect_code"]["spread"] == pytest.approx([1.0] * 3, abs=0.1)
    for level in (50, 90):
        for one in (found["joint"], *(code["coverage"] for code in found["codes"].values())):
            assert one[str(level)]["mean"] == pytest.approx(level / 100, abs=0.05)


@pytest.mark.parametrize("stretch, level", [(0.5, "bad"), (2.0, "bad")])
def test_a_guide_too_narrow_or_too_wide_is_found(stretch: float, level: str, scenes: SimpleNamespace) -> None:
    section = assess_simulation(scenes.context(scenes.guide(stretch)), samples=60)
    assert section.verdict is not None and section.verdict.level == level
    expected = math.erf(1.645 * stretch / math.sqrt(2))
    for code in section.values["program"]["codes"].values():
        assert code["coverage"]["90"]["mean"] == pytest.approx(expected, abs=0.04)


def test_what_a_model_generates_carries_what_theory_gives(scenes: SimpleNamespace) -> None:
    context = scenes.context(scenes.guide(1.2))
    with seeded(0):
        codes, window = simulate(context.model, context.validation)
        information = 1.5 * math.log(1 + scenes.precision)
        for guide in (scenes.guide(1.2), scenes.guide(1.2, reads=0.1)):
            arguments = (context.model, guide, codes, window, "effect_code", context.validation_episodes)
            found = simulated_information(*arguments, particles=50)
            assert found.high.mean == pytest.approx(information, abs=0.2)
            if guide.reads:
                assert found.low is None  # the true c is no sample of the posterior that this guide's weights aim at
            else:
                assert found.low is not None and found.low.low < information < found.high.high
                assert 0 < found.high.mean - found.low.mean < 0.1


def test_generated_windows_have_the_subgoal_as_their_last_state(cascade: CheckContext) -> None:
    with seeded(0):
        codes, window = simulate(cascade.model, cascade.validation)
    assert set(codes) == {"effect_code", "motion_code"}
    assert window.states.centers.shape == cascade.validation.states.centers.shape
    assert torch.equal(window.first.centers, cascade.validation.first.centers)
    lengths = window.states.features.norm(dim=-1)
    assert (
        torch.allclose(lengths[:, 1:-1], torch.ones_like(lengths[:, 1:-1]), atol=1e-5)
        and (lengths[:, -1] - 1).abs().max() > 0.01
    )
    section = assess_simulation(cascade, windows=8, samples=6)
    assert set(section.values) >= {"program", "clean_features"}
    assert section.verdict is not None and section.verdict.level == "too few"
