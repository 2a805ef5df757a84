"""What is drawn over a photograph of the table, in pixels: tiles, and what was considered, chosen and done.

Figures and videos draw the same things with different tools, so that what they share stands here. All pixels
are (column, row), as of `Camera.project`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.episodes import Decision
from envs.camera import Camera
from envs.layouts import Layout, Tile
from envs.workspace import TABLE_HIGH, TABLE_LOW, TILE_SIDE, push_endpoints, tile_center

Pixels = NDArray[np.float64]  # [..., 2]

# Told apart by the colour-blind too (Okabe and Ito), and by shape besides.
SUBGOAL_COLOR = "#E69F00"  # orange, as in the paper
PREDICTION_COLOR = "#007A5A"  # green
PUSH_COLOR = "#1A1A1A"
TABLE_COLOR = "#C2B9AD"  # where there is no photograph

TARGET_RADIUS = 0.07  # metres; of the circle that marks the target
MOVING = 0.01  # metres; objects that are to move less are left out


def tile_corners(tile: Tile, camera: Camera) -> Pixels:
    """[4, 2], in order around the tile."""
    around = TILE_SIDE / 2 * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
    return on_table(np.array(tile_center(tile)) + around, camera)


def on_table(points: NDArray[np.floating], camera: Camera) -> Pixels:
    """Pixels [..., 2] of points (x, y) [..., 2] metres at the table's height."""
    return camera.project(np.concatenate([points, np.zeros_like(points[..., :1])], axis=-1))


def table_box(camera: Camera) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of the table's top."""
    (left, top), (right, bottom) = on_table(np.array([TABLE_HIGH, TABLE_LOW]), camera)
    return float(left), float(top), float(right), float(bottom)


def target_circle(decision: Decision, camera: Camera) -> tuple[tuple[float, float], float]:
    """Centre and radius of a circle around the target."""
    column, row = camera.project(decision.centers[0])
    return (float(column), float(row)), TARGET_RADIUS * camera.focal_length / camera.position[2]


def observed_centers(decision: Decision, camera: Camera) -> Pixels:
    """[objects, 2] of the real objects; the target's comes first if it was seen."""
    return camera.project(decision.centers[decision.mask])


def subgoal_chains(decision: Decision, camera: Camera) -> list[Pixels]:
    """Where the chosen subgoals lead: a path [1 + segments, 2] of each object that moves."""
    return _paths(decision, decision.plan.subgoals.centers[0].numpy(), int(decision.plan.segments[0]), camera)


def predicted_paths(decision: Decision, camera: Camera) -> list[Pixels]:
    """Where f predicts that the pushes lead: a path [1 + steps, 2] of each object that moves."""
    steps = int(decision.plan.segments[0]) * decision.plan.actions.shape[1]
    return _paths(decision, decision.plan.predicted_centers[0].numpy(), steps, camera)


def pushes(decision: Decision, camera: Camera) -> Pixels:
    """Start and end [T, 2, 2] of the pushes that will be carried out."""
    return on_table(np.stack(push_endpoints(decision.plan.actions[0].numpy()), axis=1), camera)


def candidate_subgoals(
    decision: Decision, layout: Layout, camera: Camera, *, count: int
) -> tuple[Pixels, NDArray[np.float32]]:
    """Some of the subgoals that were considered, of the target alone or, in clearing, of every real object.

    Returns:
        Pixels [n, 2] and returns [n] of their plans with n at most `count`, best last.
    """
    plan = decision.plan
    centers, returns = plan.candidate_centers[0].numpy(), plan.candidate_returns[0].numpy()
    objects = np.flatnonzero(decision.mask[: centers.shape[2]]) if layout.task == "clearing" else np.array([0])
    points = centers[:, :, objects]  # [N, K, objects, 3]
    every = np.broadcast_to(returns[:, None, None], points.shape[:-1]).ravel()
    points = points.reshape(-1, 3)
    finite = np.flatnonzero(np.isfinite(every) & np.isfinite(points).all(axis=-1))
    # Drawn, not every so many-th: those would be the same segment of every plan.
    chosen = np.random.default_rng(0).permutation(finite)[:count]
    chosen = chosen[np.argsort(every[chosen], kind="stable")]
    return camera.project(points[chosen]), every[chosen]


def _paths(decision: Decision, centers: NDArray[np.float32], steps: int, camera: Camera) -> list[Pixels]:
    """`centers`: [steps or more, M, 3] metres -> the paths of the real objects that move.

    A plan may know of fewer objects than a decision has room for; those that it leaves out are padding.
    """
    objects = centers.shape[1]
    ways = np.concatenate([decision.centers[None, :objects], centers[:steps]])
    furthest = np.linalg.norm(ways[..., :2] - ways[:1, :, :2], axis=-1).max(axis=0)
    moving = decision.mask[:objects] & (furthest > MOVING) & np.isfinite(furthest)
    return [camera.project(ways[:, index]) for index in np.flatnonzero(moving)]
