"""The importance-weighted bound of the cascade (`objective=iwae`) against a second computation (`by_hand.py`)."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from cavin_pyro.config.composition import compose
from cavin_pyro.training.factory import build_objective
from guides.cascaded import CascadedGuide
from guides.guide import Guide
from guides.joint import JointGuide
from guides.mean_field import MeanFieldGuide
from models.cascaded import CascadedModel
from models.state import Window
from tests.guides import by_hand
from tests.guides.by_hand import Example, Weights

K = 4  # particles
READS = {
    CascadedGuide: {"of_actions": False, "of_effect": True},
    MeanFieldGuide: {"of_actions": False, "of_effect": False},
    JointGuide: {"of_actions": True, "of_effect": True},
}


@pytest.fixture
def window(random_window: Callable[..., Window]) -> Window:
    window = random_window().map(lambda x: x.double() if x.is_floating_point() else x)
    assert not window.transition_mask.all() and not window.sequence_mask.all()
    assert not window.states.mask.all()
    return window


@pytest.fixture(params=READS, ids=lambda guide: guide.__name__)
def programs(request: pytest.FixtureRequest) -> tuple[CascadedModel, Guide]:
    """With narrow q, so that no particle outweighs the others by far and the mean over them matters."""
    model = CascadedModel(effect_dimension=5, motion_dimension=4, feature_dimension=6, width=8).double()
    guide = request.param(model, width=8).double()
    with torch.no_grad():
        for inference, dimension in ((guide.effect_inference, 5), (guide.motion_inference, 4)):
            inference.code.head.bias[dimension:] -= 6
    return model, guide


def loss_in_training(programs: tuple[CascadedModel, Guide], window: Window) -> Tensor:
    """What `train objective=iwae` minimises."""
    config = compose("train", "objective=iwae", f"objective.elbo.num_particles={K}")
    return build_objective(config, programs[0]).bind(*programs)(window, 0)


def by_hand_in_full(programs: tuple[CascadedModel, Guide], window: Window, noise: list[Tensor]) -> SimpleNamespace:
    """Loss and the share of each particle in each window that counts, [B', K], from `noise: [K, B, D]` of each code.

    What is the same for all particles of a window, the dynamics' term, stands outside of the mean.
    """
    model, guide = programs
    w, q = Weights(model), Weights(guide)
    bound, shares = by_hand.log_transitions(w, window), []
    for b in window.sequence_mask.nonzero().flatten().tolist():
        example, weights = Example(window, b), []
        for k in range(K):
            own = [one[k, b] for one in noise]
            weights.append(by_hand.log_weight(w, q, example, *own, **READS[type(guide)]))
        largest = max(weights).detach()
        scaled = [torch.exp(weight - largest) for weight in weights]
        bound = bound + largest + torch.log(sum(scaled) / K)
        shares.append(torch.stack(scaled) / sum(scaled))
    return SimpleNamespace(loss=-bound, shares=torch.stack(shares).detach())


def test_the_bound_of_training_equals_the_hand_written_one_and_its_gradients(
    programs: tuple[CascadedModel, Guide], window: Window
) -> None:
    torch.manual_seed(11)
    loss = loss_in_training(programs, window)
    torch.manual_seed(11)
    noise = [torch.randn(K, len(window.actions), size, dtype=torch.float64) for size in (5, 4)]
    expected = by_hand_in_full(programs, window, noise)
    assert expected.shares.max(-1).values.min() < 0.5  # the mean over particles is no maximum
    assert loss.item() == pytest.approx(expected.loss.item(), rel=1e-9)
    ours = by_hand.gradients(loss, *programs)
    by_hand.assert_same(ours, by_hand.gradients(expected.loss, *programs))
    assert len(ours) > 50
