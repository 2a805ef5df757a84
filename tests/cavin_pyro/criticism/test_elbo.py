"""Does the bound fit: terms of the ELBO by window, and their difference between training and held-out windows."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from cavin_pyro.criticism.elbo import TOTAL, adjusted_difference, assess_elbo, posterior_mean_variance, scene_sizes
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.windows import seeded
from cavin_pyro.training.elbo import window_terms


def test_terms_of_windows_are_the_same_with_and_without_particles(cascade: CheckContext) -> None:
    found = []
    for particles in (None, 1):
        with seeded(3):
            found.append(window_terms(cascade.model, cascade.guide, cascade.training, particles=particles))
    for name, term in found[0].items():
        assert term.shape == (12,)
        torch.testing.assert_close(found[1][name], term.unsqueeze(0))


def test_minus_elbo_is_the_sum_of_the_terms(cascade: CheckContext) -> None:
    section = assess_elbo(cascade, samples=3)
    for part in ("training", "validation", "difference"):
        terms = {name: value.mean for name, value in section.values[part].items()}
        assert terms.pop(TOTAL) == pytest.approx(sum(terms.values()))
        assert len(terms) == 6
    assert section.values["windows"] == {"training": 12, "validation": 14}
    json.dumps(section.values, allow_nan=False)


def test_a_difference_in_the_number_of_objects_is_no_difference_of_the_model() -> None:
    objects = torch.tensor([1.0, 2, 3, 4, 3, 4, 5], dtype=torch.float64)
    held_out = torch.tensor([False, False, False, False, True, True, True])
    covariates = torch.stack((objects, 3 * objects), -1)
    found = adjusted_difference(7 - 100 * objects + 2.5 * held_out, held_out, covariates, torch.arange(7))
    assert found == pytest.approx((2.5, 2.5, 2.5))
    plain = adjusted_difference(objects, held_out, torch.ones(7, 1, dtype=torch.float64), torch.arange(7))
    assert plain.mean == pytest.approx(4 - 2.5)


def test_scenes_are_counted_where_objects_and_transitions_count(cascade: CheckContext) -> None:
    seen = cascade.validation.transition_mask.clone()
    seen[:, 1] = False
    window = cascade.validation._replace(transition_mask=seen)
    real = window.first.mask.sum(-1)
    torch.testing.assert_close(scene_sizes(window), torch.stack((real, 2 * real), -1).double())


def test_a_worse_held_out_set_is_found(scenes: SimpleNamespace) -> None:
    context = scenes.context(scenes.guide())
    context = replace(context, training_episodes=context.validation_episodes + 1000)
    worse = replace(context, validation=context.validation._replace(actions=context.validation.actions + 5))
    for one, level, phrase in ((context, "good", "not more than chance"), (worse, "bad", ", more than chance")):
        section = assess_elbo(one)
        assert section.verdict.level == level and phrase in section.findings[0]


def test_dimensions_in_use_and_their_cost_are_told(scenes: SimpleNamespace, right: SimpleNamespace) -> None:
    used = assess_elbo(scenes.context(scenes.guide()))
    assert used.values["active"]["z"] == {"active": 4, "dimensions": 4}
    cost = used.values["validation"]["KL of z"]  # all of it is information, half a logarithm for each dimension
    assert cost.low < 2 * math.log(1 + 3 * scenes.precision) < cost.high
    collapsed = assess_elbo(scenes.context(scenes.guide(blind=True)))
    assert collapsed.values["validation"]["KL of c"].mean == pytest.approx(0.0, abs=1e-6)
    assert set(assess_elbo(right.dynamics).values["training"]) == {"f: next states", TOTAL}


def test_the_noise_of_few_samples_does_not_make_a_dimension_active() -> None:
    noise = torch.randn(8, 4000, 3, generator=torch.Generator().manual_seed(0))
    assert posterior_mean_variance(noise).abs().max() < 0.02
    spread = torch.linspace(-1, 1, 4000)[:, None] * torch.tensor([0.0, 1.0, 2.0])
    expected = torch.tensor([0.0, 1 / 3, 4 / 3])
    torch.testing.assert_close(posterior_mean_variance(noise + spread), expected, rtol=0.1, atol=0.02)
