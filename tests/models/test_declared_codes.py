"""A model's `codes` declare what it offers to planners."""

from __future__ import annotations

import pytest

from models.cascaded import CascadedModel
from models.dynamics_only import DynamicsModel
from models.flat import FlatModel
from models.model import Model
from models.single_latent import SingleLatentModel


@pytest.mark.parametrize("kind", [CascadedModel, SingleLatentModel, FlatModel, DynamicsModel])
def test_a_model_offers_exactly_what_its_codes_declare(kind: type[Model]) -> None:
    model = kind(width=8)
    declared = {
        "effect_code": ("effect_dimension", "effect_prior", "subgoal"),
        "motion_code": ("motion_dimension", "motion_prior"),
    }
    for code, parts in declared.items():
        assert all(hasattr(model, part) == (code in model.codes) for part in parts)
    assert hasattr(model, "actions") == bool(model.codes)
    assert hasattr(model, "next_state")
