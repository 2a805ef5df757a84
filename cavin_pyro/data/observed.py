"""From an observation of the table to what models and planners read: the state, and the points that the camera sees."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.observation import state_of
from cavin_pyro.envs.tabletop.workspace import REACH_HIGH, REACH_LOW
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.models.state import State
from cavin_pyro.planning.additions.touchdown import ObservedPoints


def observed_state(
    observation: Mapping[str, NDArray[Any]], geometry: Geometry, device: str | torch.device = "cpu"
) -> State:
    """The planner's state, a batch of one, from an observation; see `cavin_pyro.envs.tabletop.observation.state_of`.

    `device`: of the state; `geometry` is on the CPU.
    """
    return state_of(observation, geometry).map(lambda field: field.unsqueeze(0).to(device))


def observed_points(observation: Mapping[str, NDArray[Any]], device: str | torch.device = "cpu") -> ObservedPoints:
    """The points of real objects in an observation, a batch of one: `points: [1, P, 2]` metres, object after object."""
    real = observation["mask"].astype(np.bool_)
    points = torch.from_numpy(observation["clouds"][real][..., :2].reshape(1, -1, 2))
    low, high = (torch.tensor([corner], dtype=points.dtype) for corner in (REACH_LOW, REACH_HIGH))
    return ObservedPoints(*(field.to(device) for field in (points, low, high)))
