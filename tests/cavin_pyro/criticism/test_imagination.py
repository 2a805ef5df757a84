from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.imagination import draw_imagination, imagine
from cavin_pyro.models.cascaded import CascadedModel
from cavin_pyro.models.dynamics_only import DynamicsModel
from tests.cavin_pyro.data.point import Point

SMALL = {"feature_dimension": 1, "width": 8, "maximum_objects": 1, "space": Point.space}


def test_physics_ends_where_stepping_by_hand_does_and_errors_are_distances_to_it(tmp_path: Path) -> None:
    world, model = Point(), CascadedModel(**SMALL)
    imagined = imagine(model, world, seed=3, effects=2, motions=3)
    world.reset(seed=3)
    for action in imagined.actions[1, 2]:
        observation, *_ = world.step(np.clip(action, -1, 1))
    end, _ = world.positions(observation)
    np.testing.assert_array_equal(imagined.reached[1, 2, -1], end)
    assert imagined.errors[1, 2] == np.linalg.norm(imagined.predicted[1, 2, -1, 0] - end[0])
    assert len(np.unique(imagined.actions[:, :, 0, 0])) == 6  # no two motions are the same
    table = draw_imagination(tmp_path / "imagine.png", model, world, seed=3, effects=2, motions=3)
    np.testing.assert_array_equal(table, imagined.errors)


def test_a_model_without_both_codes_is_refused() -> None:
    with pytest.raises(UserError, match="model=cascaded"):
        imagine(DynamicsModel(**SMALL), Point())
