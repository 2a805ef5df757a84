"""The ELBO of the cascade under each of its guides, against a second computation (`by_hand.py`)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from pyro.infer import Trace_ELBO
from torch import Tensor

from guides.cascaded import CascadedGuide
from guides.guide import Guide
from guides.joint import JointGuide
from guides.mean_field import MeanFieldGuide
from models.cascaded import CascadedModel
from models.state import Window
from tests.guides import by_hand

Programs = tuple[CascadedModel, Guide]
GUIDES = [CascadedGuide, MeanFieldGuide, JointGuide]


def hand_written_loss(model: CascadedModel, guide: Guide, window: Window, c_noise: Tensor, z_noise: Tensor) -> Tensor:
    """-(J_f + J_h + J_g) with the paper's J of opposite sign: the negative ELBO, summed over windows."""

    reads = {"of_actions": isinstance(guide, JointGuide), "of_effect": not isinstance(guide, MeanFieldGuide)}
    elbo = partial(by_hand.log_weight, **reads)
    return by_hand.loss_of(elbo, model, guide, window, c_noise, z_noise)


@pytest.fixture(params=GUIDES, ids=lambda guide: guide.__name__)
def programs(request: pytest.FixtureRequest) -> Programs:
    model = CascadedModel(effect_dimension=5, motion_dimension=4, feature_dimension=6, width=8).double()
    return model, request.param(model, width=8).double()


@pytest.fixture
def window(random_window: Callable[..., Window]) -> Window:
    window = random_window().map(lambda x: x.double() if x.is_floating_point() else x)
    assert not window.transition_mask.all() and not window.sequence_mask.all()
    assert not window.states.mask.all()
    return window


def test_trace_elbo_equals_the_hand_written_loss_and_its_gradients(programs: Programs, window: Window) -> None:
    torch.manual_seed(11)
    noise = by_hand.noise_of(programs[1], window)
    torch.manual_seed(11)
    loss = Trace_ELBO()(*programs)(window)
    expected = hand_written_loss(*programs, window, *noise)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-9)
    ours = by_hand.gradients(loss, *programs)
    by_hand.assert_same(ours, by_hand.gradients(expected, *programs))
    assert len(ours) > 50


def test_each_mask_takes_its_terms_out(programs: Programs, window: Window) -> None:
    none = window._replace(
        transition_mask=torch.zeros_like(window.transition_mask),
        sequence_mask=torch.zeros_like(window.sequence_mask),
    )
    loss = Trace_ELBO()(*programs)
    assert loss(none).item() == 0
    only_dynamics = by_hand.gradients(loss(window._replace(sequence_mask=none.sequence_mask)), *programs)
    for name, gradient in only_dynamics.items():
        assert (gradient.abs().max() > 0) == name.startswith(("0.encoder", "0.dynamics")), name


def test_vectorised_particles_give_the_mean_of_single_ones(programs: Programs, window: Window) -> None:
    torch.manual_seed(11)
    loss = Trace_ELBO(num_particles=8, vectorize_particles=True, max_plate_nesting=1)(*programs)(window)
    torch.manual_seed(11)
    c_noise, z_noise = torch.randn(8, 4, 5, dtype=torch.float64), torch.randn(8, 4, 4, dtype=torch.float64)
    single = [hand_written_loss(*programs, window, *noise) for noise in zip(c_noise, z_noise, strict=True)]
    expected = torch.stack(single).mean()
    assert torch.stack(single).std() > 1
    assert loss.item() == pytest.approx(expected.item(), rel=1e-9)
    by_hand.assert_same(by_hand.gradients(loss, *programs), by_hand.gradients(expected, *programs))
