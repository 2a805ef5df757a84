from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from pyro import poutine
from pyro.infer import Predictive, Trace_ELBO
from torch import nn

from guides.cascaded import CascadedGuide
from models.cascaded import CascadedModel
from models.state import Window

SIZES = {"effect_dimension": 5, "motion_dimension": 4, "feature_dimension": 6, "width": 8}


@pytest.fixture
def model() -> CascadedModel:
    return CascadedModel(**SIZES)


def test_guide_samples_exactly_the_latent_sites_of_the_model(
    model: CascadedModel, random_window: Callable[..., Window]
) -> None:
    window = random_window()
    in_model = poutine.trace(model).get_trace(window)
    in_guide = poutine.trace(CascadedGuide(model, width=8)).get_trace(window)
    assert in_guide.stochastic_nodes == in_model.stochastic_nodes == ["windows", "effect_code", "motion_code"]
    for name in ("effect_code", "motion_code"):
        assert in_guide.nodes[name]["fn"].shape() == in_model.nodes[name]["fn"].shape()


def test_model_and_guide_share_no_parameter_and_none_is_held_twice(model: CascadedModel) -> None:
    loss = Trace_ELBO()(model, CascadedGuide(model))
    parameters = list(loss.parameters())
    assert len(parameters) == len({parameter.data_ptr() for parameter in parameters})
    assert sum(p.numel() for p in parameters) == sum(p.numel() for p in set(loss.state_dict(keep_vars=True).values()))
    assert not any(name.startswith("guide.") and "encoder" in name for name in loss.state_dict())


def test_saved_networks_load_into_fresh_ones(model: CascadedModel, random_window: Callable[..., Window]) -> None:
    window = random_window()
    guide = CascadedGuide(model)
    other = CascadedModel(**SIZES)
    other_guide = CascadedGuide(other)
    losses = []
    for pair in ((model, guide), (other, other_guide)):
        torch.manual_seed(5)
        losses.append(Trace_ELBO()(*pair)(window).item())
    assert losses[0] != losses[1]
    other.load_state_dict(model.state_dict())
    other_guide.load_state_dict(guide.state_dict())
    torch.manual_seed(5)
    assert Trace_ELBO()(other, other_guide)(window).item() == losses[0]


def test_a_model_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="CascadedGuide does not fit model Linear; it fits cascaded"):
        CascadedGuide(nn.Linear(1, 1))  # type: ignore[arg-type]


def test_frozen_encoder_stays_frozen(model: CascadedModel, random_window: Callable[..., Window]) -> None:
    model.encoder.requires_grad_(False)
    loss = Trace_ELBO()(model, CascadedGuide(model))
    loss(random_window()).backward()
    assert all(not p.requires_grad and p.grad is None for p in model.encoder.parameters())
    assert all(p.grad is not None for p in loss.parameters() if p.requires_grad)


def test_training_lowers_the_loss(model: CascadedModel, random_window: Callable[..., Window]) -> None:
    window = random_window(batch=16)
    loss = Trace_ELBO()(model, CascadedGuide(model))
    optimizer = torch.optim.Adam(loss.parameters(), 3e-3)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        value = loss(window)
        value.backward()
        optimizer.step()
        losses.append(value.item())
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])


def test_reordering_objects_leaves_the_loss(model: CascadedModel, random_window: Callable[..., Window]) -> None:
    window = random_window()
    order = torch.tensor([2, 3, 0, 1])
    shuffled = window._replace(states=type(window.states)(*(field[:, :, order] for field in window.states)))
    loss = Trace_ELBO()(model, CascadedGuide(model))
    values = []
    for data in (window, shuffled):
        torch.manual_seed(5)
        values.append(loss(data).item())
    assert values[0] == pytest.approx(values[1], rel=1e-6)


def test_codes_of_a_window_regenerate_it(model: CascadedModel, random_window: Callable[..., Window]) -> None:
    sampled = Predictive(model, guide=CascadedGuide(model), num_samples=6, parallel=True)(
        random_window(), generate=True
    )
    assert sampled["effect_code"].shape == (6, 4, 5)
    assert sampled["actions"].shape == (6, 4, 3, 4)
    assert sampled["next_centers"].shape == (6, 4, 3, 4, 3)
