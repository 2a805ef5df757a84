"""The ELBOs of SeCTAR, CVAE-MPC and MPC against a second computation (`by_hand.py`)."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from pyro.infer import Trace_ELBO
from torch import Tensor

from guides.flat import FlatGuide
from guides.none import NoGuide
from guides.single_latent import SingleLatentGuide
from models.dynamics_only import DynamicsModel
from models.flat import FlatModel
from models.single_latent import SingleLatentModel
from models.state import Window
from tests.guides import by_hand
from tests.guides.by_hand import Example, Weights, effects, encode, log_pushes, pushes, q_g, q_h

SIZES = {"feature_dimension": 6, "width": 8}


@pytest.fixture
def window(random_window: Callable[..., Window]) -> Window:
    return random_window().map(lambda x: x.double() if x.is_floating_point() else x)


def check(elbo: Callable[..., Tensor], model: torch.nn.Module, guide: torch.nn.Module, window: Window) -> None:
    """Loss and gradients of Pyro, with one particle and with three, are those of `elbo` and the same noise."""
    model, guide = model.double(), guide.double()
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


@pytest.mark.parametrize("reads_actions", [False, True])
@pytest.mark.parametrize("action_weight", [1.0, 0.2])
def test_one_latent_decodes_subgoal_and_actions(window: Window, action_weight: float, reads_actions: bool) -> None:
    def elbo(w: Weights, q: Weights, x: Example, noise: Tensor) -> Tensor:
        mean, scale = q_h(q, x.s_of_both, x.goal, x.actions if reads_actions else None)
        c = mean + scale * noise
        effect = effects(w, "meta_dynamics.trunk", encode(w, x.s), c)
        decoded = x.log_subgoal(w, effect) + action_weight * log_pushes(x.actions, pushes(w, effect, None))
        return decoded - by_hand.divergence(c, mean, scale)

    model = SingleLatentModel(effect_dimension=5, action_weight=action_weight, **SIZES)
    check(elbo, model, SingleLatentGuide(model, width=8, reads_actions=reads_actions), window)


def test_a_flat_model_decodes_actions_only(window: Window) -> None:
    def elbo(w: Weights, q: Weights, x: Example, noise: Tensor) -> Tensor:
        encoded = encode(w, x.s)
        mean, scale = q_g(q, encoded, x.actions, None)
        z = mean + scale * noise
        decoded = log_pushes(x.actions, pushes(w, effects(w, "trunk", encoded, None), z))
        return decoded - by_hand.divergence(z, mean, scale)

    model = FlatModel(motion_dimension=4, **SIZES)
    check(elbo, model, FlatGuide(model, width=8), window)


def test_the_dynamics_alone_have_transitions_only(window: Window) -> None:
    model = DynamicsModel(**SIZES)
    check(lambda *_: torch.zeros(()), model, NoGuide(model), window)
