from __future__ import annotations

import pytest
import torch

from cavin_pyro.criticism.statistics.prior.classifier import classifier_test
from cavin_pyro.criticism.statistics.prior.expected_coverage import coverage_gap, credibility, expected_coverage


def normals(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_rows_of_one_distribution_are_not_auc() -> None:
    state = normals(400, 2, seed=2)
    rows = [torch.cat((state, state + normals(400, 2, seed=seed)), -1) for seed in (0, 1)]
    found = classifier_test(*rows, torch.arange(400) // 4, permutations=99)
    assert found.auc.low < 0.5 < found.auc.high and found.p_value > 0.05
    assert found.divergence.low < 0.02


def test_codes_of_other_states_are_auc_though_the_heaps_are_equal() -> None:
    state = normals(400, 2, seed=2)
    code = state + 0.3 * normals(400, 2)
    rows = [torch.cat((state, one, one - state), -1) for one in (code, code.roll(4, 0))]
    found = classifier_test(*rows, torch.arange(400) // 4, permutations=99)
    assert found.auc.low > 0.9 and found.p_value == 1 / 100 and found.divergence.mean > 0.5


def test_a_classifier_that_knows_the_episode_learns_nothing_from_it() -> None:
    """The difference between the two samples is another one in each episode, so none can be learned from others."""
    sign = (torch.randint(0, 2, (40,), generator=torch.Generator().manual_seed(1)) * 2.0 - 1).repeat_interleave(10)
    rows = [sign.unsqueeze(-1) * direction + 0.01 * normals(400, 1, seed=5) for direction in (1, -1)]
    found = classifier_test(*rows, torch.arange(400) // 10, permutations=99)
    assert found.p_value > 0.02 and found.auc.high - found.auc.low > 0.15


def test_the_bound_stays_below_the_divergence() -> None:
    found = classifier_test(1 + normals(1000, 1), normals(1000, 1, seed=1), torch.arange(1000), permutations=9)
    assert 0.3 < found.divergence.mean < 0.5 + 3 * (found.divergence.high - found.divergence.mean)  # KL is 1 / 2


def test_one_episode_and_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="two episodes"):
        classifier_test(normals(9, 2), normals(9, 2), torch.zeros(9))
    with pytest.raises(ValueError, match=r"not \[4, 2\] and \[5, 2\]"):
        classifier_test(normals(4, 2), normals(5, 2), torch.arange(4))


def test_expected_coverage_is_even_for_right_samples_and_not_for_narrow_or_foreign_ones() -> None:
    state, episodes = normals(600, 2, seed=2), torch.arange(600) // 2
    truth, reference = state + normals(600, 2), state + 0.5
    torch.manual_seed(0)
    right = credibility(truth, state + normals(40, 600, 2, seed=3), reference)
    assert coverage_gap(right, episodes).mean < 0.06
    assert torch.allclose(expected_coverage(right), torch.linspace(0.05, 0.95, 19).double(), atol=0.06)
    narrow = credibility(truth, state + 0.4 * normals(40, 600, 2, seed=3), reference)
    foreign = credibility(truth, state.roll(2, 0) + normals(40, 600, 2, seed=3), reference)
    assert coverage_gap(narrow, episodes).low > 0.1 and coverage_gap(foreign, episodes).low > 0.1
