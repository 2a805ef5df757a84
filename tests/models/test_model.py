"""The base class of model programs."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from models.cascaded import CascadedModel
from models.dynamics_only import DynamicsModel
from models.flat import FlatModel
from models.model import Model
from models.single_latent import SingleLatentModel
from models.state import State

SIZES = {"feature_dimension": 6, "width": 8}


@pytest.mark.parametrize(("options", "expected"), [({}, 4), ({"maximum_objects": 8}, 7), ({"neighbours": 2}, 2)])
@pytest.mark.parametrize("kind", [CascadedModel, SingleLatentModel, FlatModel, DynamicsModel])
def test_relations_have_as_many_others_as_in_training_or_as_asked_for(
    kind: type[Model], options: dict[str, int], expected: int
) -> None:
    model = kind(**SIZES, **options)
    assert model.neighbours == model.encoder.neighbours == model.dynamics.neighbours == expected


def test_a_scene_with_more_objects_than_in_training_is_predicted(random_state: Callable[..., State]) -> None:
    model, state, action = CascadedModel(**SIZES).eval(), random_state(3, objects=10, real=9), torch.rand(3, 4)
    predicted = model.next_state(state, action)
    assert predicted.centers.shape == (3, 10, 3) and not torch.equal(predicted.centers[:, :9], state.centers[:, :9])
    assert torch.equal(predicted.centers[:, 9], state.centers[:, 9])
    order = torch.randperm(10)
    shuffled = model.next_state(State(*(field[:, order] for field in state)), action)
    torch.testing.assert_close(shuffled.centers, predicted.centers[:, order])
