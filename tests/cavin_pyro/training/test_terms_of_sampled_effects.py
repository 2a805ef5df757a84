"""What the terms that ask the model about effects of the prior have in common."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from pyro.infer import Trace_ELBO
from torch import Tensor

from cavin_pyro.training.consistency import consistency_loss
from cavin_pyro.training.hindsight import hindsight_loss
from cavin_pyro.training.objectives import Objective
from guides.cascaded import CascadedGuide
from models.cascaded import CascadedModel
from models.state import Window
from tests.cavin_pyro.training.small_cascade import model_with

MOTIONS = 3
Loss = Callable[..., Tensor]


def hindsight_of_itself(model: CascadedModel, window: Window, **options: int) -> Tensor:
    return hindsight_loss(model, window, model, **options)


LOSSES = {"consistency": consistency_loss, "hindsight": hindsight_of_itself}
each_term = pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)


def loss_of(loss: Loss, window: Window, **options: int) -> float:
    model = model_with()
    torch.manual_seed(7)
    return loss(model, window, motions=MOTIONS, **options).item()


@each_term
def test_a_part_of_the_windows_stands_for_all(loss: Loss, small_window: Window) -> None:
    some = small_window.map(lambda tensor: tensor[:2])
    scaled = loss_of(loss, some) * len(small_window.actions) / 2
    assert loss_of(loss, small_window, windows=2) == pytest.approx(scaled, rel=1e-9)


@each_term
def test_padding_and_later_states_do_not_count(loss: Loss, small_window: Window) -> None:
    states = small_window.states
    later = torch.arange(states.centers.shape[1])[:, None, None] > 0
    padding = ~states.mask.unsqueeze(-1)
    other = states._replace(centers=torch.where(later | padding, 9.0, states.centers))
    changed = small_window._replace(states=other)
    assert loss_of(loss, changed) == pytest.approx(loss_of(loss, small_window), rel=1e-9)


@pytest.mark.parametrize("name", LOSSES)
def test_it_is_added_to_the_bound(name: str, small_window: Window) -> None:
    model = model_with()
    guide = CascadedGuide(model, width=8).double()
    losses = []
    for weight in (0.0, 0.3):
        torch.manual_seed(5)
        objective = Objective(Trace_ELBO(max_plate_nesting=1), **{f"{name}_weight": weight, f"{name}_motions": MOTIONS})
        losses.append(objective.bind(model, guide)(small_window, 0))
    torch.manual_seed(5)
    Trace_ELBO(max_plate_nesting=1)(model, guide)(small_window)  # takes the noise that it took before
    term = LOSSES[name](model, small_window, motions=MOTIONS)
    assert (losses[1] - losses[0]).item() == pytest.approx(0.3 * term.item(), rel=1e-9)
