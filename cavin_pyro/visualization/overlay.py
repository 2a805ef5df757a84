"""Overlays of an episode in pixels: tiles, candidates, subgoals, predictions and pushes.

Figures and videos share them. All pixels are (column, row), as in `Camera.project`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.tasks import Task
from cavin_pyro.envs.tabletop.workspace import (
    TABLE_CENTER,
    TABLE_HIGH,
    TABLE_LOW,
    TILE_SIDE,
    Tile,
    push_endpoints,
    tile_center,
)
from cavin_pyro.evaluation.rollout import PlanRecord

Pixels = NDArray[np.float64]  # [..., 2]

# Distinguishable by colour-blind people (Okabe and Ito), and by shape.
SUBGOAL_COLOR = "#E69F00"  # the target's: orange, as in the paper
OBSTACLE_COLOR = "#56B4E9"  # the obstacles' subgoals: sky blue
PREDICTION_COLOR = "#007A5A"  # green
REACHED_COLOR = "#C5005E"  # crimson
PUSH_COLOR = "#1A1A1A"
TABLE_COLOR = "#C2B9AD"  # where there is no photograph

PIXELS_PER_METRE = 365.5  # of maps; that of the videos' camera, so that both views have one size
TARGET_RADIUS = 0.07  # metres; of the circle that marks the target
MOVING = 0.01  # metres; objects with smaller planned moves are omitted


class View(Protocol):
    """A projection to pixels: a camera, or a map."""

    def project(self, points: NDArray[np.floating]) -> Pixels:
        """Pixels (column, row) [..., 2] of points [..., 3] metres."""


class Map:
    """A parallel projection along z. The picture's up is +x of the table, its left +y, as in the camera's image."""

    def project(self, points: NDArray[np.floating]) -> Pixels:
        """Pixels (column, row) [..., 2] of points [..., 3] metres; heights do not matter."""
        offset = np.asarray(TABLE_CENTER) - np.asarray(points, dtype=np.float64)[..., :2]
        return PIXELS_PER_METRE * offset[..., ::-1]


def tile_corners(tile: Tile, view: View) -> Pixels:
    """[4, 2], in order around the tile."""
    around = TILE_SIDE / 2 * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
    return on_table(np.array(tile_center(tile)) + around, view)


def on_table(points: NDArray[np.floating], view: View) -> Pixels:
    """Pixels [..., 2] of points (x, y) [..., 2] metres at the table's height."""
    return view.project(np.concatenate([points, np.zeros_like(points[..., :1])], axis=-1))


def table_box(view: View) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of the table's top."""
    (left, top), (right, bottom) = on_table(np.array([TABLE_HIGH, TABLE_LOW]), view)
    return float(left), float(top), float(right), float(bottom)


def circle(
    center: NDArray[np.floating], view: View, radius: float = TARGET_RADIUS
) -> tuple[tuple[float, float], float]:
    """Centre and radius of a circle of `radius` metres on the table around a point [3] metres, to mark it with."""
    column, row = view.project(center)
    edge = on_table(np.array([[0.0, 0.0], [0.0, radius]]), view)
    return (float(column), float(row)), float(np.linalg.norm(edge[1] - edge[0]))


def subgoal_chains(record: PlanRecord, view: View) -> dict[int, Pixels]:
    """The chosen subgoals: a path [1 + segments, 2] of each object that moves; object 0 is the target."""
    return object_paths(record, record.plan.subgoals.centers[0].numpy()[: int(record.plan.segments[0])], view)


def predicted_paths(record: PlanRecord, view: View) -> dict[int, Pixels]:
    """f's predictions: a path [1 + steps, 2] of each object that moves."""
    steps = int(record.plan.segments[0]) * record.plan.actions.shape[1]
    return object_paths(record, record.plan.predicted_centers[0].numpy()[:steps], view)


def pushes(record: PlanRecord, view: View) -> Pixels:
    """Start and end [T, 2, 2] of the planned pushes."""
    return on_table(np.stack(push_endpoints(record.plan.actions[0].numpy()), axis=1), view)


def candidate_subgoals(record: PlanRecord, task: Task, view: View, *, count: int) -> tuple[Pixels, NDArray[np.float32]]:
    """Some of the candidate subgoals, of every real object if the goal is about all of them, else of the target alone.

    Returns:
        Pixels [n, 2] and returns [n] of their plans with n at most `count`, best last.
    """
    plan = record.plan
    centers, returns = plan.candidate_centers[0].numpy(), plan.candidate_returns[0].numpy()
    objects = np.flatnonzero(record.mask[: centers.shape[2]]) if task.about == "all" else np.array([0])
    points = centers[:, :, objects]  # [N, K, objects, 3]
    every = np.broadcast_to(returns[:, None, None], points.shape[:-1]).ravel()
    points = points.reshape(-1, 3)
    finite = np.flatnonzero(np.isfinite(every) & np.isfinite(points).all(axis=-1))
    # A random choice: regular steps would select the same segment of every plan.
    chosen = np.random.default_rng(0).permutation(finite)[:count]
    chosen = chosen[np.argsort(every[chosen], kind="stable")]
    return view.project(points[chosen]), every[chosen]


def object_paths(record: PlanRecord, centers: NDArray[np.float32], view: View) -> dict[int, Pixels]:
    """From where the plan was made through `centers`: [n, M, 3] metres: a path [1 + n, 2] of each object that moves.

    A plan may have fewer objects than the observation; the others are padding.
    """
    objects = centers.shape[1]
    ways = np.concatenate([record.centers[None, :objects], centers])
    furthest = np.linalg.norm(ways[..., :2] - ways[:1, :, :2], axis=-1).max(axis=0)
    moving = record.mask[:objects] & (furthest > MOVING) & np.isfinite(furthest)
    return {int(index): view.project(ways[:, index]) for index in np.flatnonzero(moving)}
