"""Pyro's own tools take the programs as they take any other."""

from __future__ import annotations

from collections.abc import Callable

import pyro
import pytest
import torch
from pyro import poutine
from pyro.infer import MCMC, NUTS, SVI, Importance, Trace_ELBO
from pyro.infer.autoguide import AutoDelta, AutoNormal

from guides.cascaded import CascadedGuide
from guides.guide import Guide
from models.cascaded import CascadedModel
from models.likelihoods import LikelihoodScales
from models.model import Model
from models.state import Window
from tests.guides.pairs import GUIDES, PAIRS, make, make_model, name_of

every_pair = pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: "-".join(map(name_of, pair)))


@pytest.fixture
def cascade() -> tuple[Model, Guide]:
    return make(CascadedModel, CascadedGuide)


@every_pair
@torch.no_grad()
def test_features_that_are_handed_over_are_those_that_a_program_computes(
    pair: tuple[type[Model], type[Guide]], random_window: Callable[..., Window]
) -> None:
    model, guide = make(*pair)
    window = random_window()
    for generate in (False, True):
        for program in (model, guide):
            traces = []
            for given in ({}, {"encoded": model.encode(window, generate)}):
                torch.manual_seed(3)
                traces.append(poutine.trace(program).get_trace(window, generate=generate, **given))
            computed, handed = traces
            assert list(computed.nodes) == list(handed.nodes)
            assert float(handed.log_prob_sum()) == pytest.approx(float(computed.log_prob_sum()), rel=1e-6)


@pytest.mark.parametrize("kind", [AutoNormal, AutoDelta])
def test_an_automatic_guide_fits_the_codes_of_one_batch(
    kind: type[AutoNormal], cascade: tuple[Model, Guide], random_window: Callable[..., Window]
) -> None:
    model, window = cascade[0], random_window(batch=8)
    with pyro.settings.context(module_local_params=False):
        automatic = kind(model)
        svi = SVI(model, automatic, pyro.optim.Adam({"lr": 1e-2}), Trace_ELBO())
        losses = [svi.step(window) for _ in range(30)]
    assert sum(losses[-3:]) < sum(losses[:3])


@torch.no_grad()
def test_importance_sampling_from_the_guide_finds_the_evidence(random_window: Callable[..., Window]) -> None:
    """Wide likelihoods hardly tell about the codes, so that samples of the prior average to the same evidence."""
    wide = LikelihoodScales(center=1.0, feature=1.0, start=2.0, motion=2.0)
    model = make_model(CascadedModel, scales=wide)
    guide, window = CascadedGuide(model, **GUIDES[CascadedGuide]), random_window().map(lambda field: field[:1])

    def evidence(proposal: Callable[..., object] | None) -> float:
        return float(Importance(model, proposal, num_samples=100).run(window).get_log_normalizer())

    from_prior = evidence(None)
    assert evidence(guide) == pytest.approx(from_prior, abs=1)
    # One that does not say how likely its codes are finds another: the check can fail.
    assert evidence(poutine.mask(guide, mask=False)) != pytest.approx(from_prior, abs=1)


def test_hmc_samples_the_codes_of_a_window(cascade: tuple[Model, Guide], random_window: Callable[..., Window]) -> None:
    model = cascade[0].requires_grad_(False).eval()
    chain = MCMC(NUTS(model, max_tree_depth=3), num_samples=3, warmup_steps=3, disable_progbar=True)
    chain.run(random_window())
    samples = chain.get_samples()
    assert set(samples) == {"effect_code", "motion_code"}
    assert all(code.shape[:2] == (3, 4) and code.isfinite().all() for code in samples.values())


def test_the_graph_of_a_program_can_be_rendered(
    cascade: tuple[Model, Guide], random_window: Callable[..., Window]
) -> None:
    window = random_window()
    drawn = pyro.render_model(cascade[0], model_args=(window,)).source
    sites = pyro.infer.inspect.get_dependencies(cascade[0], (window,))["prior_dependencies"]
    assert "effect_code -> subgoal_centers" in drawn and "motion_code -> actions" in drawn
    assert "motion_code -> subgoal_centers" not in drawn
    assert {"effect_code", "motion_code"} <= set(sites["actions"])
    assert "motion_code" not in sites["subgoal_centers"]
    assert "effect_code" not in sites["next_centers"]
