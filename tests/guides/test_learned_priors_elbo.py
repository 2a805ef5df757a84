from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from pyro import poutine
from pyro.distributions import Normal
from pyro.infer import Predictive, Trace_ELBO, TraceMeanField_ELBO
from torch import Tensor, nn

from guides.cascaded import CascadedGuide
from models.cascaded import CascadedModel
from models.priors.conditional import ConditionalPrior
from models.priors.flow import FlowPrior
from models.priors.mixture import ObjectMixturePrior
from models.state import Window

SIZES = {"effect_dimension": 5, "motion_dimension": 4, "feature_dimension": 6, "width": 8}
each_prior = pytest.mark.parametrize("kind", [ConditionalPrior, FlowPrior, ObjectMixturePrior])


def programs(kind: type, *, randomized: bool = True) -> tuple[CascadedModel, CascadedGuide]:
    model = CascadedModel(
        **SIZES,
        effect_prior=kind(dimension=5, feature_dimension=6, width=8),
        motion_prior=kind(dimension=4, feature_dimension=6, effect_dimension=5, width=8),
    )
    if randomized:
        for name, parameter in model.named_parameters():
            if name.startswith("prior"):
                nn.init.normal_(parameter, std=0.3)
    return model.double(), CascadedGuide(model, width=8).double()


@pytest.fixture
def window(random_window: Callable[..., Window]) -> Window:
    return random_window().map(lambda x: x.double() if x.is_floating_point() else x)


def loss_of(objective: Trace_ELBO, pair: tuple[CascadedModel, CascadedGuide], window: Window) -> Tensor:
    torch.manual_seed(11)
    return objective(*pair)(window)


@each_prior
def test_before_training_the_loss_is_that_of_the_standard_prior(kind: type, window: Window) -> None:
    model, guide = programs(kind, randomized=False)
    standard = CascadedModel(**SIZES).double()
    standard.load_state_dict({k: v for k, v in model.state_dict().items() if not k.startswith("prior")})
    same = CascadedGuide(standard, width=8).double()
    same.load_state_dict(guide.state_dict())
    expected = loss_of(Trace_ELBO(), (standard, same), window)
    # The components of a mixture are not quite equal at first, or they would stay equal.
    tolerance = 1e-3 if kind is ObjectMixturePrior else 1e-9
    assert loss_of(Trace_ELBO(), (model, guide), window).item() == pytest.approx(expected.item(), rel=tolerance)


@each_prior
def test_codes_of_the_guide_count_under_the_learned_prior(kind: type, window: Window) -> None:
    """Against the loss with N(0, I): other are only log p(c | s) and log p(z | s, c)."""
    pair = programs(kind)
    torch.manual_seed(11)
    nodes = poutine.trace(pair[1]).get_trace(window).nodes
    c, z = nodes["effect_code"]["value"], nodes["motion_code"]["value"]
    terms = pair[0].effect_prior(window.first).log_prob(c) + pair[0].motion_prior(window.first, c).log_prob(z)
    standard = Normal(0.0, 1.0).log_prob(torch.cat([c, z], -1)).sum(-1)
    learned = loss_of(Trace_ELBO(), pair, window)
    for part in ("prior_of_effects", "prior_of_motions"):
        for parameter in getattr(pair[0], part).parameters():
            nn.init.zeros_(parameter)
        if kind is ConditionalPrior:
            getattr(pair[0], part).code.initialize_standard()
        if kind is ObjectMixturePrior:
            head = getattr(pair[0], part).head
            head.bias.data.copy_(kind(dimension=head.out_features // 8, feature_dimension=6).head.bias)
    expected = loss_of(Trace_ELBO(), pair, window) + ((standard - terms) * window.sequence_mask).sum()
    assert learned.item() == pytest.approx(expected.item(), rel=1e-9)


@each_prior
@pytest.mark.parametrize("objective", [Trace_ELBO(), TraceMeanField_ELBO()])
def test_every_weight_of_the_priors_learns(kind: type, objective: Trace_ELBO, window: Window) -> None:
    model, guide = programs(kind)
    loss_of(objective, (model, guide), window).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


def test_the_mean_field_objective_has_the_divergences_in_closed_form(window: Window) -> None:
    pair = programs(ConditionalPrior)
    torch.manual_seed(11)
    nodes = poutine.trace(pair[1]).get_trace(window).nodes
    c, z = nodes["effect_code"], nodes["motion_code"]
    priors = [pair[0].effect_prior(window.first), pair[0].motion_prior(window.first, c["value"])]
    difference = torch.zeros(4, dtype=torch.float64)
    for site, p in zip((c, z), priors, strict=True):
        q = site["fn"]
        sampled = q.log_prob(site["value"]) - p.log_prob(site["value"])
        squares = (q.variance + (q.mean - p.mean) ** 2) / (2 * p.variance)
        closed = (p.stddev.log() - q.stddev.log() + squares - 0.5).sum(-1)
        difference = difference + closed - sampled
    expected = loss_of(Trace_ELBO(), pair, window) + (difference * window.sequence_mask).sum()
    assert loss_of(TraceMeanField_ELBO(), pair, window).item() == pytest.approx(expected.item(), rel=1e-9)


@pytest.mark.parametrize("kind", [FlowPrior, ObjectMixturePrior])
def test_the_mean_field_objective_falls_back_to_samples_without_a_closed_form(kind: type, window: Window) -> None:
    pair = programs(kind)
    expected = loss_of(Trace_ELBO(), pair, window)
    assert loss_of(TraceMeanField_ELBO(), pair, window).item() == pytest.approx(expected.item(), rel=1e-12)


@each_prior
def test_particles_and_samples_run_in_parallel(kind: type, window: Window) -> None:
    pair = programs(kind)
    many = Trace_ELBO(num_particles=8, vectorize_particles=True, max_plate_nesting=1)
    assert loss_of(many, pair, window).isfinite()
    sampled = Predictive(pair[0], num_samples=6, parallel=True)(window, generate=True)
    assert sampled["effect_code"].shape == (6, 4, 5)
    assert sampled["motion_code"].shape == (6, 4, 4)
