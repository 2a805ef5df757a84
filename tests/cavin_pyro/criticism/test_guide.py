"""Is the guide calibrated: right and wrong guides of known models."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

from cavin_pyro.criticism.guide import assess_guide, importance, simulate
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.windows import seeded

FEW = {"samples": 60, "weighted": 10, "particles": 50}


def test_the_posterior_is_calibrated_and_contracts_as_theory_says(scenes: SimpleNamespace) -> None:
    section = assess_guide(scenes.context(scenes.guide()), **FEW)
    assert section.verdict.level == "good", section.findings
    found = section.values["codes"]
    assert found["effect_code"]["contraction"] == pytest.approx([0.8] * 3, abs=0.03)  # 1 - 1 / (1 + 4)
    assert found["motion_code"]["contraction"] == pytest.approx([12 / 13] * 4, abs=0.03)
    for one in (section.values["joint"], *(code["all"] for code in found.values())):
        assert one.mean == pytest.approx(0.9, abs=0.05)
    assert section.values["importance"]["unreliable"].mean == 0


@pytest.mark.parametrize("stretch", [0.5, 2.0])
def test_a_guide_too_narrow_or_too_wide_is_found(stretch: float, scenes: SimpleNamespace) -> None:
    section = assess_guide(scenes.context(scenes.guide(stretch)), **FEW)
    assert section.verdict.level == "bad"
    expected = math.erf(1.645 * stretch / math.sqrt(2))
    for code in section.values["codes"].values():
        assert code["all"].mean == pytest.approx(expected, abs=0.04)


def test_weights_of_a_guide_that_misses_the_posterior_are_unreliable(scenes: SimpleNamespace) -> None:
    right, wide, narrow = (
        importance(scenes.context(scenes.guide(stretch), batch=20, each=1), 20, 500) for stretch in (1.0, 1.2, 0.4)
    )
    # The limit of 500 is 1 - 1 / log10(500); a Gaussian of 0.4 of the width has k-hat 1 - 0.4^2.
    assert right["limit"] == pytest.approx(0.6295, abs=1e-4)
    assert right["unreliable"].mean == 0 and right["effective"].mean == pytest.approx(500)
    assert wide["unreliable"].mean < 0.1 < 0.9 < narrow["unreliable"].mean
    assert narrow["effective"].mean < wide["effective"].mean < 500


def test_generated_windows_have_the_subgoal_as_their_last_state(cascade: CheckContext) -> None:
    with seeded(0):
        codes, window = simulate(cascade.model, cascade.validation)
    assert set(codes) == {"effect_code", "motion_code"}
    assert window.states.centers.shape == cascade.validation.states.centers.shape
    assert torch.equal(window.first.centers, cascade.validation.first.centers)
    lengths = window.states.features.norm(dim=-1)
    assert torch.allclose(lengths[:, 1:-1], torch.ones_like(lengths[:, 1:-1]), atol=1e-5)
    assert (lengths[:, -1] - 1).abs().max() > 0.01  # with the noise of h's likelihood


def test_a_model_without_codes_has_no_guide_to_check(right: SimpleNamespace) -> None:
    assert assess_guide(right.dynamics).verdict.level == "none"
