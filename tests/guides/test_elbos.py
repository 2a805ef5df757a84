"""The bounds of all programs and their gradients against a second computation (`by_hand.py`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from pyro import poutine
from pyro.distributions import Normal
from pyro.infer import RenyiELBO, Trace_ELBO, TraceMeanField_ELBO
from torch import Tensor, nn

from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model
from cavin_pyro.models.priors.conditional import ConditionalPrior
from cavin_pyro.models.priors.flow import FlowPrior
from cavin_pyro.models.priors.mixture import ObjectMixturePrior
from cavin_pyro.models.state import Window
from cavin_pyro.training.bounds import loss_with_gradients
from tests.guides import by_hand
from tests.guides.by_hand import Example, Weights, effects, encode, log_pushes, pushes, q_g, q_h
from tests.guides.programs import make, make_model

CASCADE = {
    "cascaded": {"of_actions": False, "of_effect": True},
    "mean_field": {"of_actions": False, "of_effect": False},
    "joint": {"of_actions": True, "of_effect": True},
}
Elbo = Callable[..., Tensor]


def cascade(guide: str) -> Elbo:
    return lambda *given: by_hand.log_weight(*given, **CASCADE[guide])


def single_latent(action_weight: float, reads_actions: bool) -> Elbo:
    def elbo(w: Weights, q: Weights, x: Example, noise: Tensor) -> Tensor:
        mean, scale = q_h(q, x.s_of_both, x.goal, x.actions if reads_actions else None)
        c = mean + scale * noise
        effect = effects(w, "meta_dynamics.trunk", encode(w, x.s), c)
        decoded = x.log_subgoal(w, effect) + action_weight * log_pushes(x.actions, pushes(w, effect, None))
        return decoded - by_hand.divergence(c, mean, scale)

    return elbo


def flat(w: Weights, q: Weights, x: Example, noise: Tensor) -> Tensor:
    encoded = encode(w, x.s)
    mean, scale = q_g(q, encoded, x.actions, None)
    z = mean + scale * noise
    decoded = log_pushes(x.actions, pushes(w, effects(w, "trunk", encoded, None), z))
    return decoded - by_hand.divergence(z, mean, scale)


CASES: dict[str, tuple[str, str, dict[str, Any], Elbo]] = {
    **{guide: ("cascaded", guide, {}, cascade(guide)) for guide in CASCADE},
    "single_latent": ("single_latent", "single_latent", {"action_weight": 0.2}, single_latent(0.2, False)),
    "reads_actions": ("single_latent", "single_latent of actions", {}, single_latent(1.0, True)),
    "flat": ("flat", "flat", {}, flat),
    "dynamics": ("dynamics", "none", {}, lambda *_: torch.zeros(())),
}


@pytest.mark.parametrize("name", CASES)
def test_loss_and_gradients_are_those_written_by_hand(name: str, window: Window) -> None:
    model_name, guide_name, options, elbo = CASES[name]
    model, guide = (program.double() for program in make(model_name, guide_name, **options))
    torch.manual_seed(11)
    noise = by_hand.noise_of(guide, window)
    torch.manual_seed(11)
    loss = Trace_ELBO()(model, guide)(window)
    expected = by_hand.loss_of(elbo, model, guide, window, *noise)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-9)
    by_hand.assert_same(by_hand.gradients(loss, model, guide), by_hand.gradients(expected, model, guide))

    torch.manual_seed(11)
    loss = Trace_ELBO(num_particles=3, vectorize_particles=True, max_plate_nesting=1)(model, guide)(window)
    torch.manual_seed(11)
    samples = [torch.randn(3, *one.shape, dtype=torch.float64) for one in noise]
    single = [by_hand.loss_of(elbo, model, guide, window, *(one[n] for one in samples)) for n in range(3)]
    assert loss.item() == pytest.approx(sum(single).item() / 3, rel=1e-9)


@pytest.mark.parametrize("guide", CASCADE)
def test_each_mask_takes_its_terms_out(guide: str, window: Window) -> None:
    programs = tuple(program.double() for program in make("cascaded", guide))
    none = window.map(torch.zeros_like)
    loss = Trace_ELBO()(*programs)
    without_codes = window._replace(sequence_mask=none.sequence_mask)
    assert loss(without_codes._replace(transition_mask=none.transition_mask)).item() == 0
    for name, gradient in by_hand.gradients(loss(without_codes), *programs).items():
        assert (gradient.abs().max() > 0) == name.startswith(("0.encoder", "0.dynamics")), name


@pytest.mark.parametrize("guide", CASCADE)
@pytest.mark.parametrize("alpha", [0.0, 0.5])
def test_the_renyi_bound_and_its_gradients_are_those_written_by_hand(alpha: float, guide: str, window: Window) -> None:
    """With narrow q, so that no particle outweighs the others by far and the mean over them matters."""
    particles = 4
    model, q = (program.double() for program in make("cascaded", guide))
    with torch.no_grad():
        for inference, dimension in ((q.effect_inference, 5), (q.motion_inference, 4)):
            inference.code.head.bias[dimension:] -= 6
    bound = RenyiELBO(alpha=alpha, num_particles=particles, vectorize_particles=True, max_plate_nesting=1)
    torch.manual_seed(11)
    loss = loss_with_gradients(bound, model, q, window, [*model.parameters(), *q.parameters()])
    torch.manual_seed(11)
    noise = [torch.randn(particles, 4, size, dtype=torch.float64) for size in (5, 4)]
    weights, weights_of_q = Weights(model), Weights(q)
    # What is the same for all particles of a window, the dynamics' term, stands outside of the mean.
    expected = by_hand.log_transitions(weights, window)
    for b in window.sequence_mask.nonzero().flatten().tolist():
        own = [[one[k, b] for one in noise] for k in range(particles)]
        each = [by_hand.log_weight(weights, weights_of_q, Example(window, b), *pair, **CASCADE[guide]) for pair in own]
        largest = max(each).detach()
        scaled = [torch.exp((1 - alpha) * (weight - largest)) for weight in each]
        assert max(scaled) < 0.95 * sum(scaled)  # the mean over particles is no maximum
        expected = expected + largest + torch.log(sum(scaled) / particles) / (1 - alpha)
    assert loss.item() == pytest.approx(-expected.item(), rel=1e-9)
    by_hand.assert_same(by_hand.gradients(loss, model, q), by_hand.gradients(-expected, model, q))


def test_more_particles_and_flows_tighten_the_bound(window: Window) -> None:
    programs = [program.double() for program in make("cascaded", "flow")]
    bounds = []
    for alpha in (1e-3, 0.999):
        torch.manual_seed(3)
        elbo = RenyiELBO(alpha=alpha, num_particles=8, vectorize_particles=True, max_plate_nesting=1)
        bounds.append(elbo.loss(*programs, window))
    assert bounds[0] < bounds[1]


each_prior = pytest.mark.parametrize("kind", [ConditionalPrior, FlowPrior, ObjectMixturePrior])


def with_priors(kind: type) -> tuple[Model, Guide]:
    effect_prior = kind(space=SPACE, dimension=5, feature_dimension=6, width=8)
    motion_prior = kind(space=SPACE, dimension=4, feature_dimension=6, effect_dimension=5, width=8)
    model = make_model("cascaded", effect_prior=effect_prior, motion_prior=motion_prior)
    for name, parameter in model.named_parameters():
        if name.startswith("prior"):
            nn.init.normal_(parameter, std=0.3)
    return model.double(), CascadedGuide(model, width=8).double()


def loss_of(elbo: Trace_ELBO, programs: tuple[Model, Guide], window: Window) -> Tensor:
    torch.manual_seed(11)
    return elbo(*programs)(window)


def under_standard_priors(programs: tuple[Model, Guide]) -> tuple[Model, Guide]:
    """The same weights with N(0, I) for the priors."""
    model, guide = make("cascaded", "cascaded")
    model.load_state_dict({k: v for k, v in programs[0].state_dict().items() if not k.startswith("prior")})
    guide.load_state_dict(programs[1].state_dict())
    return model.double(), guide.double()


@each_prior
def test_codes_of_the_guide_count_under_the_learned_prior_and_all_its_weights_learn(kind: type, window: Window) -> None:
    """Against the loss with N(0, I): other are only log p(c | s) and log p(z | s, c)."""
    model, guide = with_priors(kind)
    torch.manual_seed(11)
    nodes = poutine.trace(guide).get_trace(window).nodes
    c, z = nodes["effect_code"]["value"], nodes["motion_code"]["value"]
    learned = model.effect_prior(window.first).log_prob(c) + model.motion_prior(window.first, c).log_prob(z)
    standard = Normal(0.0, 1.0).log_prob(torch.cat([c, z], -1)).sum(-1)
    difference = ((standard - learned) * window.sequence_mask).sum()
    expected = loss_of(Trace_ELBO(), under_standard_priors((model, guide)), window) + difference
    loss = loss_of(Trace_ELBO(), (model, guide), window)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-6)
    loss.backward()
    assert not [name for name, one in model.named_parameters() if one.grad is None or not one.grad.any()]


@each_prior
def test_the_mean_field_bound_has_divergences_in_closed_form_or_samples(kind: type, window: Window) -> None:
    model, guide = with_priors(kind)
    torch.manual_seed(11)
    nodes = poutine.trace(guide).get_trace(window).nodes
    c, z = nodes["effect_code"], nodes["motion_code"]
    priors = [model.effect_prior(window.first), model.motion_prior(window.first, c["value"])]
    difference = torch.zeros(4, dtype=torch.float64)
    for site, p in zip((c, z), priors if kind is ConditionalPrior else (), strict=False):
        q = site["fn"]
        sampled = q.log_prob(site["value"]) - p.log_prob(site["value"])
        squares = (q.variance + (q.mean - p.mean) ** 2) / (2 * p.variance)
        difference = difference + (p.stddev.log() - q.stddev.log() + squares - 0.5).sum(-1) - sampled
    expected = loss_of(Trace_ELBO(), (model, guide), window) + (difference * window.sequence_mask).sum()
    assert loss_of(TraceMeanField_ELBO(), (model, guide), window).item() == pytest.approx(expected.item(), rel=1e-9)
