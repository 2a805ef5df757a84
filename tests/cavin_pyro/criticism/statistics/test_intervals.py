from __future__ import annotations

import pytest

from cavin_pyro.criticism.statistics.intervals import as_percent, normal_interval


def test_an_interval_has_its_estimate_in_the_middle() -> None:
    assert normal_interval({"mean": 2.0, "standard_error": 0.5}) == pytest.approx((1.02, 2.98))


def test_a_share_is_shown_in_per_cent_with_ends_that_a_share_can_have() -> None:
    interval = {"mean": 0.914, "low": -0.2, "high": 1.3}
    assert as_percent(interval) == "91% (0% to 100%)"
    assert as_percent({**interval, "low": 0.876, "high": 0.95}, digits=1) == "91.4% (87.6% to 95.0%)"
