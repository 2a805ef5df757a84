"""Assignment of a goal's places to objects of similar shape."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from envs.goals.goal import Goal
from envs.markings import Place
from envs.observation import Observation

SHAPE_WEIGHT = 100.0  # metres of distance that one metre of shape difference is worth


def assign(observation: Observation, goal: Goal) -> tuple[Place, ...]:
    """A place (x, y) in metres for each object of an episode's first observation, in the objects' order.

    The assignment of least cost: the distance of an object and a place, plus `SHAPE_WEIGHT` times the difference of
    their `outlines`. So a millimetre of height or length costs as much as 10 cm of distance, and objects of equal shape
    take the nearest places.

    Args:
        goal: with as many objects as the observation.
    """
    own = np.flatnonzero(observation.mask)
    way = np.linalg.norm(observation.centers[own, None, :2] - goal.centers[None, :, :2], axis=-1)
    shape = np.linalg.norm(outlines(observation.clouds[own])[:, None] - outlines(goal.clouds)[None], axis=-1)
    _, places = linear_sum_assignment(way + SHAPE_WEIGHT * shape)
    return tuple((float(x), float(y)) for x, y in goal.centers[places, :2])


def outlines(clouds: NDArray[np.floating]) -> NDArray[np.float64]:
    """Measures of clouds [n, P, 3] metres that are invariant to rotation on the table, [n, 3] metres.

    These are the height of the top, and the standard deviations of the points along their longer and their shorter axis
    in the plan view.
    """
    points = np.asarray(clouds, dtype=np.float64)
    flat = points[..., :2] - points[..., :2].mean(axis=-2, keepdims=True)
    covariance = np.einsum("npi,npj->nij", flat, flat) / points.shape[-2]
    spread = np.sqrt(np.linalg.eigvalsh(covariance).clip(min=0.0))[:, ::-1]
    return np.concatenate([np.quantile(points[..., 2], 0.95, axis=-1)[:, None], spread], axis=-1)
