"""One plan over a photograph or a map, for pictures and videos, and its legend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, Normalize, to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, Patch, Polygon
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from cavin_pyro.evaluation.rollout import PlanRecord
from cavin_pyro.visualization.overlay import (
    OBSTACLE_COLOR,
    PREDICTION_COLOR,
    PUSH_COLOR,
    REACHED_COLOR,
    SUBGOAL_COLOR,
    Pixels,
    View,
    candidate_subgoals,
    circle,
    predicted_paths,
    pushes,
    reached_paths,
    subgoal_chains,
    tile_corners,
)
from envs.markings import PLACE_RADIUS
from envs.scene import COLORS
from envs.tasks import Task

CANDIDATES = 150  # dots per panel
# Nothing else in the picture is purple. The palest part is cut off: it would be lost on the table.
RETURNS = ListedColormap(colormaps["Purples"](np.linspace(0.2, 1.0, 128)))

Style = dict[str, Any]
_HALO = [withStroke(linewidth=2.8, foreground="white", alpha=0.85)]
_OBSERVED: Style = {
    "marker": "o",
    "markersize": 4.5,
    "color": "white",
    "markeredgecolor": "black",
    "linestyle": "",
}
_CANDIDATE: Style = {"marker": "o", "markersize": 3.5, "color": "#6A51A3", "linestyle": ""}
_SUBGOALS: Style = {"marker": "o", "markersize": 5.5, "color": SUBGOAL_COLOR, "linewidth": 2.2}
_SUBGOALS |= {"markeredgecolor": "black", "markeredgewidth": 0.7}
_OBSTACLES: Style = {**_SUBGOALS, "marker": "s", "markersize": 4.5, "color": OBSTACLE_COLOR, "linewidth": 1.6}
_PREDICTED: Style = {"marker": "x", "markersize": 4, "color": PREDICTION_COLOR, "linewidth": 1.2}
_REACHED: Style = {"marker": "D", "markersize": 3, "color": REACHED_COLOR, "linewidth": 1.2}
_PUSH: Style = {"arrowstyle": "-|>", "mutation_scale": 10, "shrinkA": 0, "shrinkB": 0, "linewidth": 1.4}
_PLACE: Style = {"fill": False, "linewidth": 2.4}
_TARGET: Style = {"color": PUSH_COLOR, "linestyle": "--", "linewidth": 1.5}


def draw_overlay(
    panel: Axes,
    record: PlanRecord,
    task: Task,
    view: View,
    scale: Normalize | None,
    reached: NDArray[np.float32] | None = None,
) -> None:
    """Draw observed objects, candidates, subgoals, predictions and pushes over the panel's background.

    Args:
        scale: of the candidates' returns; None omits the candidates.
        reached: [n, M, 3] metres, centres observed after each push; None before that.
    """
    if scale is not None:
        dots, returns = candidate_subgoals(record, task, view, count=CANDIDATES)
        panel.scatter(dots[:, 0], dots[:, 1], s=9, c=returns, norm=scale, cmap=RETURNS, alpha=0.8, zorder=2)
    for path in predicted_paths(record, view).values():
        panel.plot(path[:, 0], path[:, 1], **_PREDICTED, path_effects=_HALO, zorder=3)
    for number, chain in subgoal_chains(record, view).items():
        style = _SUBGOALS if number == 0 else _OBSTACLES
        panel.plot(chain[:, 0], chain[:, 1], **style, markevery=slice(1, None), zorder=4 if number == 0 else 3.5)
    _draw_pushes(panel, record, view)
    if reached is not None:
        draw_paths(panel, reached_paths(record, reached, view))
    draw_objects(panel, record.centers, record.mask, view)
    draw_places(panel, task, view)


def draw_paths(panel: Axes, paths: Mapping[int, Pixels]) -> None:
    """Draw the observed paths of objects."""
    for path in paths.values():
        panel.plot(path[:, 0], path[:, 1], **_REACHED, markevery=slice(1, None), path_effects=_HALO, zorder=6)


def draw_tiles(panel: Axes, task: Task, view: View) -> None:
    """Draw the task's region and goal."""
    for group in task.tile_groups():
        fill = to_rgba(group.color, group.opacity)
        for tile in group.tiles:
            corners = tile_corners(tile, view)
            panel.add_patch(Polygon(corners, facecolor=fill, edgecolor=group.color, linewidth=1.4, zorder=1))


def draw_objects(panel: Axes, centers: NDArray[np.float32], mask: NDArray[np.bool_], view: View) -> None:
    """Draw the centres [M, 3] metres of the objects in the mask [M], with a ring around the target."""
    pixels = view.project(centers[mask])
    panel.plot(pixels[:, 0], pixels[:, 1], **_OBSERVED, zorder=6)
    if mask[0]:
        center, radius = circle(centers[0], view)
        panel.add_patch(Circle(center, radius, fill=False, path_effects=_HALO, zorder=6, **_TARGET))


def draw_places(panel: Axes, task: Task, view: View) -> None:
    """Draw a ring in each object's colour around the place where it has to go, if the task has places."""
    for (x, y), color in zip(task.object_places(), COLORS, strict=False):
        center, radius = circle(np.array([x, y, 0.0]), view, PLACE_RADIUS)
        panel.add_patch(Circle(center, radius, color=color, path_effects=_HALO, zorder=5, **_PLACE))


def legend(task: Task, plan_records: Sequence[PlanRecord], *, candidates: bool) -> list[Line2D | Patch]:
    """Legend entries for exactly what `draw_overlay` draws of an episode."""
    entries: list[Line2D | Patch] = [
        Patch(facecolor=to_rgba(group.color, group.opacity), edgecolor=group.color, label=group.name)
        for group in task.tile_groups()
    ]
    if task.object_places():
        ring: Style = {"marker": "o", "markersize": 9, "markerfacecolor": "none", "markeredgewidth": 2, "linestyle": ""}
        entries.append(Line2D([], [], label="places", color=COLORS[0], **ring))
    entries.append(Line2D([], [], label="target", **_TARGET))
    entries.append(Line2D([], [], label="observed", **_OBSERVED))
    if candidates:
        entries.append(Line2D([], [], label="candidates", **_CANDIDATE))
    if any(record.plan.subgoals.centers.shape[1] for record in plan_records):
        entries.append(Line2D([], [], label="target's subgoals", **_SUBGOALS))
        if any(record.mask[1:].any() for record in plan_records):
            entries.append(Line2D([], [], label="obstacles' subgoals", **_OBSTACLES))
    if any(record.plan.predicted_centers.shape[1] for record in plan_records):
        entries.append(Line2D([], [], label="predicted", **_PREDICTED))
    entries.append(Line2D([], [], label="reached", **_REACHED))
    arrow: Style = {"marker": r"$\rightarrow$", "markersize": 15, "color": PUSH_COLOR, "linestyle": ""}
    entries.append(Line2D([], [], label="push", **arrow))
    return entries


def counted(number: int) -> str:
    """`1 push`, `2 pushes`."""
    return f"{number} push" if number == 1 else f"{number} pushes"


def _draw_pushes(panel: Axes, record: PlanRecord, view: View) -> None:
    """Arrows, numbered behind their starts in the order of execution."""
    for number, (start, end) in enumerate(pushes(record, view), 1):
        order = 6 - 0.1 * number  # earlier ones on top: pushes often follow one another along a line
        arrow = FancyArrowPatch(start, end, color=PUSH_COLOR, path_effects=_HALO, zorder=order, **_PUSH)
        panel.add_patch(arrow)
        x, y = start - 8 * (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)  # 8 pixels
        panel.text(x, y, str(number), ha="center", va="center", fontsize=8, path_effects=_HALO, zorder=7)
