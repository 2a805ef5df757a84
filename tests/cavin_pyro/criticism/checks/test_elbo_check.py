from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from cavin_pyro.criticism.checks.elbo import assess_elbo
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.statistics.elbo import TOTAL, adjusted_difference, scene_sizes
from cavin_pyro.criticism.statistics.windows import seeded
from cavin_pyro.training.elbo import elbo_terms, window_terms


def test_terms_of_windows_sum_to_those_of_the_batch_with_and_without_particles(cascade: CheckContext) -> None:
    with seeded(3):
        whole = elbo_terms(cascade.model, cascade.guide, cascade.training)
    with seeded(3):
        single = window_terms(cascade.model, cascade.guide, cascade.training)
    with seeded(3):
        several = window_terms(cascade.model, cascade.guide, cascade.training, particles=1)
    for name, term in single.items():
        assert term.shape == (12,)
        torch.testing.assert_close(term.sum(), whole[name])
        torch.testing.assert_close(several[name], term.unsqueeze(0))
    held = {name: torch.zeros(7, 12, 4, dtype=torch.float64) for name in cascade.codes}
    terms = window_terms(cascade.model, cascade.guide, cascade.training, particles=7, fixed=held)
    assert all(torch.equal(term, term[:1].expand(7, 12)) for term in terms.values())


def test_minus_elbo_is_the_sum_of_the_terms(cascade: CheckContext) -> None:
    section = assess_elbo(cascade, samples=3, batch=5)
    for part in ("training", "validation", "difference"):
        terms = {name: value["mean"] for name, value in section.values[part].items()}
        assert terms.pop(TOTAL) == pytest.approx(sum(terms.values()))
        assert len(terms) == 6
    assert section.values["windows"] == {"training": 12, "validation": 14}
    json.dumps(section.values, allow_nan=False)


def test_neither_the_order_of_windows_nor_that_of_objects_matters_but_for_noise(cascade: CheckContext) -> None:
    order = torch.tensor([4, 2, 0, 3, 1])
    states = cascade.validation.states
    shuffled = cascade.validation._replace(
        states=type(states)(states.centers[:, :, order], states.features[:, :, order], states.mask[..., order])
    )
    first, second = (
        assess_elbo(replace(cascade, validation=window), samples=2).values for window in (cascade.validation, shuffled)
    )
    for term, value in first["validation"].items():
        assert second["validation"][term]["mean"] == pytest.approx(value["mean"], rel=1e-9)


def test_a_difference_in_the_number_of_objects_is_no_difference_of_the_model() -> None:
    objects = torch.tensor([1.0, 2, 3, 4, 3, 4, 5], dtype=torch.float64)
    held_out = torch.tensor([False, False, False, False, True, True, True])
    found = adjusted_difference(7 - 100 * objects + 2.5 * held_out, held_out, torch.stack((objects, 3 * objects), -1))
    assert found["mean"] == pytest.approx(2.5)
    assert found["standard_error"] == pytest.approx(0.0, abs=1e-9)
    plain = adjusted_difference(objects, held_out, torch.ones(7, 1, dtype=torch.float64))
    assert plain["mean"] == pytest.approx(4 - 2.5)


def test_scenes_are_counted_where_objects_and_transitions_count(cascade: CheckContext) -> None:
    seen = cascade.validation.transition_mask.clone()
    seen[:, 1] = False
    window = cascade.validation._replace(transition_mask=seen)
    real = window.first.mask.sum(-1)
    torch.testing.assert_close(scene_sizes(window), torch.stack((real, 2 * real), -1).double())


def test_a_worse_held_out_set_is_reported(linear: SimpleNamespace) -> None:
    context = linear.context(linear.guide(), batch=400)
    worse = replace(context, validation=context.validation._replace(actions=context.validation.actions + 2))
    for one, phrase in ((context, "not more than chance"), (worse, "worse than on training windows, more than chance")):
        assert phrase in assess_elbo(one).findings[0]


def test_a_model_without_codes_has_its_likelihood_terms(linear: SimpleNamespace) -> None:
    assert set(assess_elbo(linear.no_code()).values["training"]) == {"h: subgoal centres", TOTAL}
