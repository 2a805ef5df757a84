"""Estimates with intervals over episodes, and the levels that follow from them."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.stats import kstest

from cavin_pyro.criticism.estimates import covered, mean_interval, rank, ratio_interval
from cavin_pyro.criticism.section import conclude, grade, within, worst


def test_copies_of_a_window_add_no_evidence() -> None:
    values = torch.randn(50, generator=torch.Generator().manual_seed(0))
    once = mean_interval(values, torch.arange(50))
    error = values.double().std().item() / math.sqrt(50)
    assert once.high - once.mean == pytest.approx(2.0096 * error, rel=1e-4)  # of Student's t with 49
    episodes = torch.arange(50).repeat_interleave(4)
    assert mean_interval(values.repeat_interleave(4), episodes) == pytest.approx(once)
    resampled = ratio_interval(values.repeat_interleave(4), torch.ones(200), episodes)
    assert resampled.mean == pytest.approx(once.mean, abs=1e-6)
    assert resampled[1:] == pytest.approx(once[1:], abs=0.08)


def test_an_interval_over_episodes_holds_the_truth_as_often_as_it_says() -> None:
    generator = torch.Generator().manual_seed(1)
    common = torch.randn(400, 30, generator=generator).repeat_interleave(5, 1)
    values = common + torch.randn(400, 150, generator=generator)
    found = [mean_interval(row, torch.arange(30).repeat_interleave(5)) for row in values]
    assert 0.92 <= sum(one.low < 0 < one.high for one in found) / 400 <= 0.98
    naive = [mean_interval(row, torch.arange(150)) for row in values]
    assert sum(one.low < 0 < one.high for one in naive) / 400 < 0.85


def test_what_cannot_be_known_has_no_interval() -> None:
    assert mean_interval(torch.ones(3), torch.zeros(3))[1:] == (-math.inf, math.inf)
    assert all(math.isnan(end) for end in mean_interval(torch.full((3,), math.nan), torch.arange(3)))
    assert mean_interval(torch.tensor([1.0, math.nan, 1.0]), torch.arange(3)).mean == 1.0
    assert all(math.isnan(end) for end in ratio_interval(torch.zeros(3), torch.zeros(3), torch.arange(3)))


def test_ranks_are_uniform_for_samples_of_the_truth_and_not_for_narrow_ones() -> None:
    torch.manual_seed(0)
    truth, samples = torch.randn(1000), torch.randn(20, 1000)
    assert kstest(rank(samples, truth).numpy(), "uniform").pvalue > 0.01
    assert covered(rank(samples, truth), 0.9).mean() == pytest.approx(0.9, abs=0.03)
    assert kstest(rank(0.5 * samples, truth).numpy(), "uniform").pvalue < 1e-6
    assert covered(rank(0.5 * samples, truth), 0.9).mean() < 0.7
    ties = rank(torch.zeros(9, 1000), torch.zeros(1000))
    assert kstest(ties.numpy(), "uniform").pvalue > 0.01


def test_levels_follow_the_interval_not_the_estimate() -> None:
    ends = ((0, 1), (0, 1.5), (1.5, 3), (2, 9), (math.nan, math.nan))
    assert [grade(*one, good=1, bad=2) for one in ends] == ["good", "inspect", "inspect", "bad", "inspect"]
    bands = {"good": (0.86, 0.94), "bad": (0.8, 0.98)}
    ends = ((0.87, 0.93), (0.84, 0.92), (0.6, 0.7), (0.985, 1.0), (0.7, 0.95))
    assert [within(*one, **bands) for one in ends] == ["good", "inspect", "bad", "bad", "inspect"]
    assert worst(["good", "bad", "inspect"]) == "bad" and worst([]) == "none"


def test_too_little_gives_a_warning_in_place_of_a_verdict() -> None:
    assert conclude("good", "Rule.", "Do.", torch.arange(400) % 60).advice == ""
    assert conclude("bad", "Rule.", "Do.", torch.arange(400) % 60).advice == "Do."
    for episodes in (torch.arange(99), torch.arange(400) % 49):
        found = conclude("good", "Rule.", "Do.", episodes)
        assert found.level == "too few" and "Rule." in found.rule and "more" in found.advice
