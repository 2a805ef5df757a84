"""Our own pairs of model and guide pass."""

from __future__ import annotations

import pyro
import pytest
import torch
from torch import Tensor, nn

from cavin_pyro.config.errors import UserError
from cavin_pyro.training.compatibility import check_compatibility
from guides.cascaded import CascadedGuide
from guides.flow import FlowGuide
from models.cascaded import CascadedModel
from models.priors.flow import FlowPrior
from models.state import State, Window
from tests.guides.pairs import PAIRS, make, make_model


class WithMore(CascadedGuide):
    """Draws something that the model does not know."""

    def forward(self, window: Window, generate: bool = False, encoded: Tensor | None = None) -> None:
        super().forward(window, generate, encoded)
        pyro.sample("more", pyro.distributions.Normal(0.0, 1.0))


@pytest.fixture
def window() -> Window:
    mask = torch.arange(4).expand(3, 4, 4) < 3
    state = State(torch.rand(3, 4, 4, 3), nn.functional.normalize(torch.randn(3, 4, 4, 6), dim=-1), mask)
    counted = torch.ones(3, 3, dtype=torch.bool)
    return Window(state, torch.rand(3, 3, 4), counted, counted[:, 0])


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: "-".join(part.__name__ for part in pair))
def test_compatible_models_and_guides_pass_and_random_numbers_are_unchanged(pair: tuple, window: Window) -> None:
    programs = make(*pair)
    state = torch.get_rng_state()
    check_compatibility(*programs, window)
    assert torch.equal(torch.get_rng_state(), state)


def test_flows_fit(window: Window) -> None:
    model = make_model(CascadedModel, effect_prior=FlowPrior(dimension=5, feature_dimension=6))
    check_compatibility(model, FlowGuide(model, width=8), window)


def test_a_guide_with_an_additional_site_is_refused(window: Window) -> None:
    model = make_model(CascadedModel)
    with pytest.raises(
        UserError, match="samples effect_code, more, motion_code, but the codes of model CascadedModel are"
    ):
        check_compatibility(model, WithMore(model, width=8), window)


def test_compatibility_can_be_checked_on_one_window(window: Window) -> None:
    model = make_model(CascadedModel)
    check_compatibility(model, CascadedGuide(model, width=8), window.map(lambda field: field[:1]))
