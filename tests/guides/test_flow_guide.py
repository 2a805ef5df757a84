from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from pyro import poutine
from pyro.infer import RenyiELBO, Trace_ELBO, TraceMeanField_ELBO
from torch import nn

from guides.cascaded import CascadedGuide
from guides.flow import FlowGuide
from models.cascaded import CascadedModel
from models.state import Window

SIZES = {"effect_dimension": 5, "motion_dimension": 4, "feature_dimension": 6, "width": 8}


@pytest.fixture
def model() -> CascadedModel:
    return CascadedModel(**SIZES).double()


@pytest.fixture
def guide(model: CascadedModel) -> FlowGuide:
    return FlowGuide(model, width=8, flow_width=8).double()


@pytest.fixture
def window(random_window: Callable[..., Window]) -> Window:
    return random_window().map(lambda x: x.double() if x.is_floating_point() else x)


def stir(guide: FlowGuide) -> None:
    for name, parameter in guide.named_parameters():
        if ".flow." in name:
            nn.init.normal_(parameter, std=0.3)


def plain(guide: FlowGuide, model: CascadedModel) -> CascadedGuide:
    """The guide without flows, of the same weights."""
    other = CascadedGuide(model, width=8).double()
    weights = {
        name.replace(".gaussian", ""): value for name, value in guide.state_dict().items() if ".flow." not in name
    }
    other.load_state_dict(weights)
    return other


@pytest.mark.parametrize(
    "objective", [Trace_ELBO(), Trace_ELBO(num_particles=3, vectorize_particles=True, max_plate_nesting=1)]
)
def test_with_identity_flows_it_is_the_plain_guide(
    objective: Trace_ELBO, model: CascadedModel, guide: FlowGuide, window: Window
) -> None:
    losses, gradients = [], []
    for one in (plain(guide, model), guide):
        torch.manual_seed(11)
        losses.append(objective(model, one)(window))
        loss_of = {f"model.{name}": value for name, value in model.named_parameters()}
        loss_of |= {
            name.replace(".gaussian", ""): value for name, value in one.named_parameters() if ".flow." not in name
        }
        gradients.append(dict(zip(loss_of, torch.autograd.grad(losses[-1], list(loss_of.values())), strict=True)))
    assert losses[0].item() == pytest.approx(losses[1].item(), rel=1e-12)
    assert gradients[0].keys() == gradients[1].keys() and len(gradients[0]) > 50
    for name, gradient in gradients[0].items():
        assert gradient.abs().max() > 0, name
        assert torch.allclose(gradient, gradients[1][name], rtol=1e-9, atol=1e-9 * gradient.abs().max()), name


def test_flows_that_are_not_the_identity_change_the_codes(
    model: CascadedModel, guide: FlowGuide, window: Window
) -> None:
    stir(guide)
    values = []
    for one in (plain(guide, model), guide):
        torch.manual_seed(11)
        traced = poutine.trace(one).get_trace(window)
        values.append([traced.nodes[name]["value"] for name in ("effect_code", "motion_code")])
    for with_flow, without in zip(*values, strict=True):
        assert (with_flow - without).abs().min() > 0


def test_every_weight_of_the_flows_learns(model: CascadedModel, guide: FlowGuide, window: Window) -> None:
    stir(guide)
    Trace_ELBO()(model, guide)(window).backward()
    for name, parameter in guide.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


def test_the_mean_field_objective_falls_back_to_samples(model: CascadedModel, guide: FlowGuide, window: Window) -> None:
    stir(guide)
    losses = []
    for objective in (Trace_ELBO(), TraceMeanField_ELBO()):
        torch.manual_seed(3)
        losses.append(objective(model, guide)(window).item())
    assert losses[0] == pytest.approx(losses[1], rel=1e-12)


def test_more_particles_tighten_the_bound(model: CascadedModel, guide: FlowGuide, window: Window) -> None:
    stir(guide)
    bounds = []
    for alpha in (1e-3, 0.999):
        torch.manual_seed(3)
        objective = RenyiELBO(alpha=alpha, num_particles=8, vectorize_particles=True, max_plate_nesting=1)
        bounds.append(objective.loss(model, guide, window))
    assert bounds[0] < bounds[1]


def test_training_lowers_the_loss(random_window: Callable[..., Window]) -> None:
    model = CascadedModel(**SIZES)
    window, loss = random_window(batch=16), Trace_ELBO()(model, FlowGuide(model, width=8, flow_width=8))
    optimizer = torch.optim.Adam(loss.parameters(), 3e-3)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        value = loss(window)
        value.backward()
        optimizer.step()
        losses.append(value.item())
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])


def test_a_model_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="FlowGuide does not fit model Linear; it fits cascaded"):
        FlowGuide(nn.Linear(1, 1))  # type: ignore[arg-type]
