from __future__ import annotations

import json
import math
from types import SimpleNamespace

import pytest
import torch

from cavin_pyro.criticism.checks.amortization import assess_amortization
from cavin_pyro.criticism.context import CheckContext

FEW = {"windows": 30, "steps": 200, "particles": 16, "samples": 1000}


@pytest.mark.parametrize(
    "shift, stretch",
    [(0.0, 1.0), (-2.0, 0.5), *(pytest.param(*pair, marks=pytest.mark.soak) for pair in ((1.0, 1.0), (0.0, 2.0)))],
)
def test_refinement_recovers_the_guides_known_error(shift: float, stretch: float, linear: SimpleNamespace) -> None:
    section = assess_amortization(linear.context(linear.guide(shift, stretch)), **FEW)
    divergence = 2 * (0.5 * shift**2 + 0.5 * stretch**2 - 0.5 - math.log(stretch))  # of two dimensions
    assert section.values["gap"]["mean"] == pytest.approx(divergence, abs=0.06)
    # The family holds the posterior.
    assert section.values["approximation_gap"]["mean"] == pytest.approx(0.0, abs=0.05)


def test_a_cascade_is_refined_without_being_changed(cascade: CheckContext) -> None:
    before = {name: value.clone() for name, value in [*cascade.model.state_dict().items()]}
    section = assess_amortization(cascade, windows=6, steps=30, particles=4, samples=50)
    assert section.values["gap"]["mean"] > 0
    assert section.values["refined_elbo"]["mean"] > section.values["elbo"]["mean"]
    json.dumps(section.values, allow_nan=False)
    assert all(torch.equal(value, before[name]) for name, value in cascade.model.state_dict().items())
    assert not any(parameter.requires_grad for parameter in cascade.guide.parameters())


def test_no_gap_without_codes(linear: SimpleNamespace) -> None:
    assert assess_amortization(linear.no_code(), **FEW).values == {}
