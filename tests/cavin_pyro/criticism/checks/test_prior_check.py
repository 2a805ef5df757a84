from __future__ import annotations

import json
from types import SimpleNamespace

import pytest
import torch

from cavin_pyro.criticism.checks.aggregate import assess_aggregate
from cavin_pyro.criticism.checks.prior import _elsewhere, assess_prior
from cavin_pyro.criticism.context import CheckContext

FEW = {"samples": 20, "permutations": 99}


def test_a_prior_that_is_right_passes_and_one_of_other_scenes_fails(scenes: SimpleNamespace) -> None:
    right = assess_prior(scenes.context(scenes.guide()), **FEW)
    wrong = assess_prior(scenes.context(scenes.guide(), shuffled=True), **FEW)
    assert right.verdict is not None and right.verdict.level == "good", right.findings
    assert wrong.verdict is not None and wrong.verdict.level == "bad"
    apart = wrong.values["classifier"]["prior"]
    assert apart["auc"]["low"] > 0.8 and apart["p_value"] == 1 / 100
    # The control is what the shuffled prior is: a test that could not see it would prove nothing.
    assert right.values["classifier"]["shuffled"]["auc"]["low"] > 0.8
    # Heaps of codes without their states look alike, so the marginal test must not be asked.
    marginal = assess_aggregate(scenes.context(scenes.guide(), shuffled=True), permutations=99)
    assert marginal.values["effect_code"]["all_dimensions"]["p_value"] > 0.05


def test_few_episodes_give_a_warning_instead_of_a_conclusion(scenes: SimpleNamespace) -> None:
    section = assess_prior(scenes.context(scenes.guide(), batch=120, each=6), **FEW)
    assert section.verdict is not None and section.verdict.level == "too few"
    assert "120 windows of 20 episodes" in section.verdict.rule


@pytest.mark.parametrize(
    "numbers", [[0, 0, 0, 1], [0, 1], [0, 0, 1, 1], [2, 0, 2, 2, 1, 2, 2], [5, 5, 1, 2, 1], [0, 1, 2], [1] * 9 + [0]]
)
def test_another_scene_is_one_of_another_episode(numbers: list[int]) -> None:
    episodes = torch.tensor(numbers)
    other = _elsewhere(episodes)
    assert (episodes[other] != episodes).all()
    assert torch.equal(other, _elsewhere(episodes))
    if 2 * max(map(numbers.count, numbers)) <= len(numbers):
        assert sorted(other.tolist()) == list(range(len(numbers)))  # each window stands in for one other


def test_windows_of_one_episode_stand_in_for_themselves() -> None:
    assert _elsewhere(torch.zeros(3)).tolist() == [0, 1, 2]


def test_pushes_and_subgoals_of_a_cascade_are_compared(cascade: CheckContext) -> None:
    section = assess_prior(cascade, windows=10, **FEW)
    assert set(section.values["decoded"]) >= {"first_push_near", "overlap", "farthest_move"}
    assert set(section.values["coverage"]) == {"codes", "first push"}
    near = section.values["decoded"]["first_push_near"]
    assert near["guide_minus"]["prior"]["mean"] == pytest.approx(near["guide"]["mean"] - near["prior"]["mean"])
    again = assess_prior(cascade, windows=10, **FEW)
    assert torch.equal(
        torch.tensor(again.values["coverage_by_chance"]), torch.tensor(section.values["coverage_by_chance"])
    )
    assert again.findings == section.findings


def test_a_model_without_codes_has_no_prior(linear: SimpleNamespace) -> None:
    section = assess_prior(linear.no_code())
    assert section.verdict is not None and section.verdict.level == "none"
    json.dumps(section.values)
