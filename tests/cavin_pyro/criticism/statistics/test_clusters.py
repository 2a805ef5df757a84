from __future__ import annotations

import math

import pytest
import torch

from cavin_pyro.criticism.statistics.clusters import bootstrap_interval, mean_interval, mean_with_error
from cavin_pyro.criticism.verdicts.verdict import conclude, grade, within, worst


def test_copies_of_a_window_add_no_evidence() -> None:
    values = torch.randn(50, generator=torch.Generator().manual_seed(0))
    once = mean_with_error(values, torch.arange(50))
    assert once["standard_error"] == pytest.approx(values.double().std().item() / math.sqrt(50))
    fourfold = mean_with_error(values.repeat_interleave(4), torch.arange(50).repeat_interleave(4))
    assert fourfold["standard_error"] == pytest.approx(once["standard_error"])
    resampled = bootstrap_interval(
        lambda weights: weights @ values.repeat_interleave(4).double() / weights.sum(-1),
        torch.arange(50).repeat_interleave(4),
    )
    interval = mean_interval(values.repeat_interleave(4), torch.arange(50).repeat_interleave(4))
    assert resampled.low == pytest.approx(interval.low, abs=0.08)
    assert resampled.high == pytest.approx(interval.high, abs=0.08)


def test_an_interval_over_episodes_holds_the_truth_as_often_as_it_says() -> None:
    generator = torch.Generator().manual_seed(1)
    common = torch.randn(400, 30, generator=generator).repeat_interleave(5, 1)
    values = common + torch.randn(400, 150, generator=generator)
    episodes = torch.arange(30).repeat_interleave(5)
    found = [mean_interval(row, episodes) for row in values]
    assert 0.92 <= sum(one.low < 0 < one.high for one in found) / 400 <= 0.98
    naive = [mean_interval(row, torch.arange(150)) for row in values]
    assert sum(one.low < 0 < one.high for one in naive) / 400 < 0.85


def test_what_cannot_be_known_has_no_interval() -> None:
    assert mean_interval(torch.ones(3), torch.zeros(3))[1:] == (-math.inf, math.inf)
    assert all(math.isnan(end) for end in mean_interval(torch.full((3,), math.nan), torch.arange(3)))
    assert mean_interval(torch.tensor([1.0, math.nan, 1.0]), torch.arange(3)).mean == 1.0


def test_levels_follow_the_interval_not_the_estimate() -> None:
    assert [grade(*ends, good=1, bad=2) for ends in ((0, 1), (0, 1.5), (1.5, 3), (2, 9))] == [
        "good",
        "inspect",
        "inspect",
        "bad",
    ]
    assert grade(math.nan, math.nan, good=1, bad=2) == "inspect"
    bands = {"good": (0.86, 0.94), "bad": (0.8, 0.98)}
    ends = ((0.87, 0.93), (0.84, 0.92), (0.6, 0.7), (0.985, 1.0), (0.7, 0.95))
    assert [within(*one, **bands) for one in ends] == ["good", "inspect", "bad", "bad", "inspect"]
    assert worst(["good", "bad", "inspect"]) == "bad" and worst([]) == "none"


def test_too_little_gives_a_warning_in_place_of_a_verdict() -> None:
    assert conclude("good", "Rule.", "Do.", windows=400, episodes=torch.arange(60)).advice == ""
    assert conclude("bad", "Rule.", "Do.", windows=400, episodes=60).advice == "Do."
    for windows, episodes in ((99, 60), (400, 49)):
        found = conclude("good", "Rule.", "Do.", windows=windows, episodes=episodes)
        assert found.level == "too few" and "Rule." in found.rule and "more" in found.advice
