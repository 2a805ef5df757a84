"""The programs with dynamics that see contact and predict their own scales."""

from __future__ import annotations

import pyro
import pytest
import torch
from pyro import distributions, poutine

from guides.cascaded import CascadedGuide
from models.cascaded import CascadedModel
from models.likelihoods import LikelihoodScales, PredictedScales
from models.networks.contact.dynamics import ContactDynamics
from models.networks.outline import Outline
from models.state import State, Window


def model_with(scales: LikelihoodScales) -> CascadedModel:
    torch.manual_seed(0)
    return CascadedModel(width=8, scales=scales, dynamics=ContactDynamics(object_width=8, pair_width=4))


def window(batch: int = 3, objects: int = 2) -> Window:
    clouds = 0.03 * torch.randn(batch, 4, objects, 32, 3)
    centers = torch.tensor([0.5, 0.0, 0.02]) + 0.1 * torch.randn(batch, 4, objects, 3)
    states = State(centers, Outline()(clouds), torch.ones(batch, 4, objects, dtype=torch.bool))
    counted = torch.ones(batch, 3, dtype=torch.bool)
    return Window(states, 2 * torch.rand(batch, 3, 4) - 1, counted, counted[:, 0])


def test_f_is_scored_by_students_t_with_its_own_scales() -> None:
    model, seen = model_with(PredictedScales()), window()
    site = poutine.trace(model).get_trace(seen).nodes["next_centers"]
    mean, scales = model.dynamics.outcome(seen.states.step(slice(0, -1)), None, seen.actions)
    expected = distributions.MultivariateStudentT(
        torch.tensor(3.0), mean.centers, scales[..., :1, None] * torch.eye(3)
    ).log_prob(seen.states.centers[:, 1:])
    assert torch.allclose(site["fn"].log_prob(site["value"]), expected.sum((-1, -2)), atol=1e-3)


def test_fixed_scales_ignore_those_that_f_predicts() -> None:
    model, seen = model_with(LikelihoodScales()), window()
    site = poutine.trace(model).get_trace(seen).nodes["next_centers"]
    mean = model.dynamics(seen.states.step(slice(0, -1)), None, seen.actions)
    expected = distributions.Normal(mean.centers, 0.01).log_prob(seen.states.centers[:, 1:])
    assert torch.allclose(site["fn"].log_prob(site["value"]), expected.sum((-1, -2, -3)), rtol=1e-4)


def test_the_elbo_trains_f_with_its_scales() -> None:
    model, seen = model_with(PredictedScales()), window()
    guide = CascadedGuide(model)
    pyro.infer.Trace_ELBO().differentiable_loss(model, guide, seen).backward()
    for name, weight in model.dynamics.named_parameters():
        assert weight.grad is not None, name
        assert weight.grad.abs().max() > 0, name


def test_generation_samples_as_widely_as_f_says() -> None:
    model, seen = model_with(PredictedScales()), window(batch=400, objects=1)
    seen = Window(
        State(*(field[:1].expand_as(field) for field in seen.states)),
        seen.actions[:1].expand_as(seen.actions),
        seen.transition_mask,
        seen.sequence_mask,
    )
    held = poutine.condition(model, {"actions": seen.actions})
    trace = poutine.trace(held).get_trace(seen, generate=True)
    drawn = trace.nodes["next_centers_1"]["value"][:, 0]
    mean, scales = model.dynamics.outcome(seen.first, None, seen.actions[:, 0])
    spread = ((drawn - mean.centers[:, 0]).abs().median() / scales[0, 0, 0]).item()
    # The median of |t| with 3 degrees of freedom.
    assert spread == pytest.approx(0.765, abs=0.08)


def test_a_sampled_state_is_as_far_from_the_mean_as_f_says() -> None:
    model, seen = model_with(PredictedScales()), window(batch=2)
    state, push = seen.states.step(0), seen.actions[:, 0]
    state = state._replace(mask=torch.tensor([[True, True], [True, False]]))
    mean, scales = model.dynamics.outcome(state, None, push)
    certain = model.sampled_next_state(state, push, torch.zeros(2, 2, 2))
    assert torch.equal(certain.centers, mean.centers)
    uniform = torch.full((2, 2, 2), 0.5)
    off = (model.sampled_next_state(state, push, uniform).centers - mean.centers).norm(dim=-1)
    expected = scales[..., 0] * (3.0 * (0.5 ** (-2.0 / 3.0) - 1.0)) ** 0.5
    assert torch.allclose(off[state.mask], expected[state.mask], rtol=1e-3)
    assert off[1, 1] == 0.0
