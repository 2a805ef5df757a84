"""Pyro's own tools take the programs as they take any other."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pyro
import pytest
import torch
from pyro import infer, poutine
from pyro.infer import MCMC, NUTS, Importance, Predictive
from pyro.infer.reparam import LocScaleReparam

from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.models.likelihoods import LikelihoodScales
from cavin_pyro.models.state import Window
from tests.guides.programs import make, make_model

PROGRAMS = [("cascaded", "cascaded"), ("single_latent", "single_latent"), ("flat", "flat"), ("dynamics", "none")]
every_program = pytest.mark.parametrize("pair", PROGRAMS, ids="-".join)


@every_program
def test_codes_of_a_window_regenerate_it(pair: tuple[str, str], random_window: Callable[..., Window]) -> None:
    model, guide = make(*pair)
    for options in ({}, {"guide": guide, "parallel": True}):
        sampled = Predictive(model.generate, num_samples=6, **options)(random_window())
        assert sampled["next_centers_3"].shape == (6, 4, 4, 3) and sampled["next_centers_3"].isfinite().all()
        assert ("actions" in sampled) == bool(model.codes)
        assert ("subgoal_centers" in sampled) == ("effect_code" in model.codes)


@every_program
def test_generation_follows_conditions_and_interventions(
    pair: tuple[str, str], random_window: Callable[..., Window]
) -> None:
    model, window = make(*pair)[0], random_window()
    site = (*model.codes, "next_centers_1")[0]
    shape = poutine.trace(model.generate).get_trace(window).nodes[site]["value"].shape
    for handler in (poutine.condition, poutine.do):
        results = []
        for value in (0.0, 0.0, 3.0):
            torch.manual_seed(0)
            program = handler(model.generate, data={site: torch.full(shape, value)})
            results.append(poutine.trace(program).get_trace(window).nodes["next_centers_2"]["value"])
        assert torch.equal(results[0], results[1]) and not torch.equal(results[0], results[2])


def test_f_follows_actions_that_are_set_and_a_guide_needs_whole_windows(random_window: Callable[..., Window]) -> None:
    (model, guide), window = make("cascaded", "cascaded"), random_window()
    backwards = poutine.do(model, data={"actions": -window.actions})
    means = [poutine.trace(one).get_trace(window).nodes["next_centers"]["fn"].mean for one in (model, backwards)]
    assert torch.equal(means[0], poutine.trace(model).get_trace(window).nodes["next_centers"]["fn"].mean)
    assert not torch.equal(*means)
    with pytest.raises(ValueError, match="infers from whole windows"):
        guide(window.initial)


@torch.no_grad()
def test_importance_sampling_from_the_guide_finds_the_evidence(random_window: Callable[..., Window]) -> None:
    """Wide likelihoods hardly tell about the codes, so that samples of the prior average to the same evidence."""
    wide = LikelihoodScales(SPACE, center=1.0, feature=1.0, action=(2.0, 2.0))
    model = make_model("cascaded", scales=wide)
    guide, window = CascadedGuide(model, width=8), random_window().map(lambda field: field[:1])

    def evidence(proposal: Callable[..., object] | None) -> float:
        return float(Importance(model, proposal, num_samples=40).run(window).get_log_normalizer())

    from_prior = evidence(None)
    assert evidence(guide) == pytest.approx(from_prior, abs=1)
    # One that does not say how likely its codes are finds another: the check can fail.
    assert evidence(poutine.mask(guide, mask=False)) != pytest.approx(from_prior, abs=1)


def test_nuts_and_reparameterisation_find_the_codes(random_window: Callable[..., Window]) -> None:
    model = make_model("cascaded").requires_grad_(False).eval()
    chain = MCMC(NUTS(model, max_tree_depth=3), num_samples=3, warmup_steps=3, disable_progbar=True)
    chain.run(random_window())
    samples = chain.get_samples()
    assert set(samples) == set(model.codes)
    assert all(code.shape[:2] == (3, 4) and code.isfinite().all() for code in samples.values())
    config = {name: LocScaleReparam(0.0) for name in model.codes}
    trace = poutine.trace(poutine.reparam(model, config=config)).get_trace(random_window())
    assert all(f"{name}_decentered" in trace.nodes for name in model.codes)


def test_the_graph_of_a_program_can_be_rendered(random_window: Callable[..., Window]) -> None:
    model, window = make_model("cascaded"), random_window()
    drawn = partial(pyro.render_model, model_args=(window,))(model).source
    sites = infer.inspect.get_dependencies(model, (window,))["prior_dependencies"]
    assert "effect_code -> subgoal_centers" in drawn and "motion_code -> actions" in drawn
    assert "motion_code -> subgoal_centers" not in drawn
    assert set(model.codes) <= set(sites["actions"])
    assert "motion_code" not in sites["subgoal_centers"] and "effect_code" not in sites["next_centers"]
