from __future__ import annotations

import json
from types import SimpleNamespace

import pytest
import torch
from scipy.stats import energy_distance

from cavin_pyro.criticism.checks.aggregate import assess_aggregate
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.statistics.prior.two_sample import compare_codes, energy_test, projection


def normals(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_distance_is_scipys_over_its_largest_value() -> None:
    x, y = normals(50, 1), 0.5 + 2 * normals(50, 1, seed=1)
    across = 2 * (x - y.T).abs().mean().item()
    expected = energy_distance(x[:, 0].numpy(), y[:, 0].numpy()) ** 2 / across
    assert energy_test(x, y).distance == pytest.approx(expected)


def test_equal_distributions_are_rejected_as_often_as_the_level_says() -> None:
    p_values = [
        energy_test(normals(60, 3, seed=n), normals(60, 3, seed=1000 + n), permutations=99).p_value for n in range(200)
    ]
    assert 0.01 <= sum(p <= 0.05 for p in p_values) / 200 <= 0.10
    assert 0.4 <= sum(p <= 0.5 for p in p_values) / 200 <= 0.6


@pytest.mark.parametrize("shift, scale", [(0.4, 1.0), (0.0, 1.5)])
def test_a_shift_and_another_spread_are_found(shift: float, scale: float) -> None:
    test = energy_test(normals(400, 3), shift + scale * normals(400, 3, seed=1), permutations=199)
    assert test.p_value == 1 / 200
    assert test.distance > 5 * test.chance


def test_what_rows_have_in_common_is_no_difference() -> None:
    common = 100 * normals(100, 2, seed=2)
    assert energy_test(common + normals(100, 2), common + normals(100, 2, seed=1)).p_value > 0.05
    assert energy_test(common + normals(100, 2), common + 1 + normals(100, 2, seed=1)).p_value == 1 / 1000


def test_samples_of_different_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"not \[4, 2\] and \[5, 2\]"):
        energy_test(normals(4, 2), normals(5, 2))


def test_the_dimensions_that_differ_are_named_and_projected_on() -> None:
    guide, prior = normals(500, 6), normals(500, 6, seed=1)
    guide[:, 4] *= 2.0
    guide[:, 2] *= 1.5
    comparison = compare_codes(
        guide, prior, active=torch.tensor([False, False, True, False, True, False]), permutations=99
    )
    assert comparison.worst[0] == 4
    assert (comparison.p_values < 0.05).nonzero().flatten().tolist() in ([4], [2, 4])
    directions = projection(comparison)
    assert directions[4, 0].abs() > 0.9
    assert directions[2, 1].abs() > 0.9
    assert comparison.active is not None
    assert comparison.active.distance > comparison.whole.distance  # nothing dilutes it


def test_a_guide_spread_as_the_prior_passes_and_a_shifted_one_does_not(linear: SimpleNamespace) -> None:
    for guide in (linear.blind(), linear.guide()):
        section = assess_aggregate(linear.context(guide, batch=300), windows=300, permutations=99)
        assert section.values["together"]["p_value"] > 0.05
        assert all(
            "cannot be distinguished, without their states, from" in sentence for sentence in section.findings[:2]
        )
    shifted = assess_aggregate(linear.context(linear.blind(0.5), batch=300), windows=300, permutations=99)
    assert shifted.values["effect_code"]["all_dimensions"]["p_value"] == 1 / 100
    assert shifted.values["effect_code"]["active_dimensions"] is None
    assert "differ from" in shifted.findings[0]


def test_pictures_and_values_for_each_code(cascade: CheckContext, linear: SimpleNamespace) -> None:
    section = assess_aggregate(cascade, windows=10, permutations=9)
    assert [picture.name for picture in section.pictures] == ["aggregate_effect_code", "aggregate_motion_code"]
    json.dumps(section.values, allow_nan=False)
    assert "together" not in assess_aggregate(linear.one_code(), permutations=9).values
    assert "no codes" in assess_aggregate(linear.no_code()).findings[0]
