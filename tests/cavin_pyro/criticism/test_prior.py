"""Is the prior the aggregate posterior given the state: right priors, and those of other scenes."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.prior import area_under_curve, assess_prior, held_out_logits, other_episodes


def normals(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_a_prior_that_is_right_passes_and_one_of_other_scenes_fails(scenes: SimpleNamespace) -> None:
    right = assess_prior(scenes.context(scenes.guide(), batch=300))
    wrong = assess_prior(scenes.context(scenes.guide(), shuffled=True, batch=300))
    assert right.verdict.level == "good", right.findings
    assert wrong.verdict.level == "bad" and wrong.values["auc"]["prior"].low > 0.8
    # The control is what the shuffled prior is: a test that could not see it would prove nothing.
    assert right.values["auc"]["control"].low > 0.8


def test_a_guide_whose_codes_are_off_the_prior_is_found(scenes: SimpleNamespace) -> None:
    shifted = assess_prior(scenes.context(scenes.guide(blind=True, shift=1.0), batch=300))
    assert shifted.verdict.level == "bad"


def test_codes_of_other_states_are_told_apart_though_the_heaps_are_equal() -> None:
    state, episodes = normals(400, 2, seed=2), torch.arange(400) // 4
    same = [torch.cat((state, state + normals(400, 2, seed=seed)), -1) for seed in (0, 1)]
    chance = area_under_curve(*held_out_logits(*same, episodes, 0), episodes)
    assert chance.low < 0.5 < chance.high
    code = state + 0.3 * normals(400, 2)
    apart = [torch.cat((state, one, one - state), -1) for one in (code, code.roll(4, 0))]
    assert area_under_curve(*held_out_logits(*apart, episodes, 0), episodes).low > 0.9


def test_a_classifier_that_knows_the_episode_learns_nothing_from_it() -> None:
    """The difference between the two samples is another one in each episode, so none can be learned from others."""
    sign = (torch.randint(0, 2, (40,), generator=torch.Generator().manual_seed(1)) * 2.0 - 1).repeat_interleave(10)
    rows = [sign.unsqueeze(-1) * direction + 0.01 * normals(400, 1, seed=5) for direction in (1, -1)]
    episodes = torch.arange(400) // 10
    found = area_under_curve(*held_out_logits(*rows, episodes, 0), episodes)
    assert found.low < 0.5 and found.high - found.low > 0.15


@pytest.mark.parametrize("numbers", [[0, 1], [0, 0, 1, 1], [5, 5, 1, 2, 1], [0, 1, 2]])
def test_another_scene_is_one_of_another_episode(numbers: list[int]) -> None:
    episodes = torch.tensor(numbers)
    other = other_episodes(episodes)
    assert (episodes[other] != episodes).all() and sorted(other.tolist()) == list(range(len(numbers)))


def test_what_codes_of_a_cascade_decode_to_is_compared(cascade: CheckContext) -> None:
    section = assess_prior(cascade, windows=10)
    assert section.findings == assess_prior(cascade, windows=10).findings
    assert section.figure is not None


def test_without_codes_or_a_second_episode_there_is_nothing_to_compare(
    right: SimpleNamespace, scenes: SimpleNamespace
) -> None:
    assert assess_prior(right.dynamics).verdict.level == "none"
    assert assess_prior(scenes.context(scenes.guide(), batch=6, each=6)).verdict.level == "none"
