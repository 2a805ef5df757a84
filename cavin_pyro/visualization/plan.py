"""The plans of an episode as a picture, over the camera's image or on a map: the paper's qualitative figure.

The video shows each plan with the same `draw_overlay`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, Patch, Polygon
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.markings import PLACE_RADIUS
from cavin_pyro.envs.tabletop.scene import COLORS
from cavin_pyro.envs.tabletop.sensors.camera import Camera
from cavin_pyro.envs.tabletop.tasks import Task
from cavin_pyro.envs.tabletop.workspace import TABLE_HIGH, TABLE_LOW
from cavin_pyro.evaluation.rollout import Episode, PlanRecord
from cavin_pyro.visualization.overlay import (
    OBSTACLE_COLOR,
    PREDICTION_COLOR,
    PUSH_COLOR,
    REACHED_COLOR,
    SUBGOAL_COLOR,
    TABLE_COLOR,
    Map,
    Pixels,
    View,
    candidate_subgoals,
    circle,
    object_paths,
    predicted_paths,
    pushes,
    subgoal_chains,
    table_box,
    tile_corners,
)
from cavin_pyro.visualization.training import DOTS_PER_INCH, save_figure

PANELS = 5  # plans shown, besides the end
CANDIDATES = 150  # dots per panel
MARGIN = 8  # pixels around the table
GRID = 0.25  # metres between two marks on an axis
SUCCESS_COLOR, FAILURE_COLOR = "#1B6E1B", "#C2272D"
# Nothing else in the picture is purple. The palest part is cut off: it would be lost on the table.
RETURNS = ListedColormap(colormaps["Purples"](np.linspace(0.2, 1.0, 128)))

Style = dict[str, Any]
_HALO = [withStroke(linewidth=2.8, foreground="white", alpha=0.85)]
OBSERVED: Style = {"marker": "o", "markersize": 4.5, "color": "white", "markeredgecolor": "black", "linestyle": ""}
_CANDIDATE: Style = {"marker": "o", "markersize": 3.5, "color": "#6A51A3", "linestyle": ""}
_SUBGOALS: Style = {"marker": "o", "markersize": 5.5, "color": SUBGOAL_COLOR, "linewidth": 2.2}
_SUBGOALS |= {"markeredgecolor": "black", "markeredgewidth": 0.7}
_OBSTACLES: Style = {**_SUBGOALS, "marker": "s", "markersize": 4.5, "color": OBSTACLE_COLOR, "linewidth": 1.6}
_PREDICTED: Style = {"marker": "x", "markersize": 4, "color": PREDICTION_COLOR, "linewidth": 1.2}
_REACHED: Style = {"marker": "D", "markersize": 3, "color": REACHED_COLOR, "linewidth": 1.2}
SHOWN = {  # in every world
    **{"observed": OBSERVED, "candidates": _CANDIDATE, "subgoals of object 0": _SUBGOALS},
    **{"of the others": _OBSTACLES, "predicted": _PREDICTED, "reached": _REACHED},
}
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
    draw_predictions(panel, record, view)
    _draw_pushes(panel, record, view)
    if reached is not None:
        draw_paths(panel, object_paths(record, reached, view))
    draw_objects(panel, record.centers, record.mask, view)
    draw_places(panel, task, view)


def draw_predictions(panel: Axes, record: PlanRecord, view: View) -> None:
    """Draw the paths that f predicts, and the chosen subgoals."""
    for path in predicted_paths(record, view).values():
        panel.plot(path[:, 0], path[:, 1], **_PREDICTED, path_effects=_HALO, zorder=3)
    for number, chain in subgoal_chains(record, view).items():
        style = _SUBGOALS if number == 0 else _OBSTACLES
        panel.plot(chain[:, 0], chain[:, 1], **style, markevery=slice(1, None), zorder=4 if number == 0 else 3.5)


def draw_paths(panel: Axes, paths: Mapping[int, Pixels]) -> None:
    """Draw the observed paths of objects."""
    for path in paths.values():
        panel.plot(path[:, 0], path[:, 1], **_REACHED, markevery=slice(1, None), path_effects=_HALO, zorder=6)


def draw_objects(panel: Axes, centers: NDArray[np.float32], mask: NDArray[np.bool_], view: View) -> None:
    """Draw the centres [M, 3] metres of the objects in the mask [M], with a ring around the target."""
    pixels = view.project(centers[mask])
    panel.plot(pixels[:, 0], pixels[:, 1], **OBSERVED, zorder=6)
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
    entries.append(Line2D([], [], label="observed", **OBSERVED))
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


def mark_axes(panel: Axes, view: View) -> None:
    """Name x and y, in metres."""
    for axis, set_ticks in ((0, panel.set_yticks), (1, panel.set_xticks)):
        marks = GRID * np.arange(np.ceil(TABLE_LOW[axis] / GRID), np.floor(TABLE_HIGH[axis] / GRID) + 1)
        places = view.project(np.outer(marks, np.eye(3)[axis]))[:, 1 - axis]
        set_ticks(places, [f"{mark:g}" for mark in marks], fontsize=7)
    panel.set_xlabel("y (m)", fontsize=8)
    panel.set_ylabel("x (m)", fontsize=8)


def draw_plan(path: Path, episode: Episode, task: Task, camera: Camera | None) -> None:
    """Draw at most five plans, evenly spread and in temporal order, and the end.

    Parts that a planner lacks are omitted.

    Args:
        episode: its plans hold photographs and observations, or an empty table is drawn.
        camera: that took the photographs, in any resolution; None draws maps from above instead, with the clouds.
    """
    count = len(episode.plan_records)
    chosen = np.linspace(0, count - 1, min(PANELS, count)).round().astype(int)  # the first and the last among them
    plan_records = [episode.plan_records[index] for index in chosen]
    panels = len(plan_records) + 1
    columns = {2: 2, 4: 2}.get(panels, 3)
    rows = -(-panels // columns)
    figure = Figure(figsize=(4.4 * columns, 0.9 + 2.95 * rows), dpi=DOTS_PER_INCH, layout="constrained")  # inches
    axes = figure.subplots(rows, columns, squeeze=False)
    scale = return_scale(np.concatenate([record.plan.candidate_returns[0].numpy() for record in plan_records]))
    for panel, record in zip(axes.flat, plan_records, strict=False):
        draw_plan_record(panel, record, task, camera, scale, episode.reached(record))
    draw_end(axes.flat[panels - 1], episode, task, camera)
    for panel in axes.flat[panels:]:
        panel.set_axis_off()
    if scale is not None:
        bar = figure.colorbar(ScalarMappable(scale, RETURNS), ax=axes, fraction=0.02, pad=0.01, aspect=30)
        bar.set_label("return of a candidate", fontsize=9)
        bar.ax.tick_params(labelsize=8)
    figure.suptitle(
        f"{task.name}, seed {episode.seed}: {episode.outcome} after {counted(len(episode.transitions))}", fontsize=12
    )
    handles = legend(task, plan_records, candidates=scale is not None)
    entries = len(handles) if columns == 3 else -(-len(handles) // 2)
    figure.legend(handles=handles, loc="outside lower center", ncols=entries, fontsize=9, frameon=False)
    save_figure(path, figure)


def draw_plan_record(
    panel: Axes,
    record: PlanRecord,
    task: Task,
    camera: Camera | None,
    scale: Normalize | None,
    reached: NDArray[np.float32] | None = None,
) -> None:
    """Draw one plan over its photograph, or on a map.

    Args:
        camera: that took the photograph, in any resolution; None draws a map.
        scale: of the candidates' returns; None omits the candidates.
        reached: [n, M, 3] metres, centres observed after each push; None before that.
    """
    view = _draw_ground(panel, task, camera, record.photograph, record.observation, record.mask)
    draw_overlay(panel, record, task, view, scale, reached)
    lines = [f"after {counted(record.step)}{_error(record, reached)}", record.prospect.removeprefix(", ")]
    panel.set_title("\n".join(filter(None, lines)), fontsize=10)


def return_scale(returns: NDArray[np.float32]) -> Normalize | None:
    """A colour scale for the returns [n] that are finite; None where none is."""
    finite = returns[np.isfinite(returns)]
    if len(finite) == 0:
        return None
    low, high = float(finite.min()), float(finite.max())
    return Normalize(low, high if high > low else low + 1.0)


def _error(record: PlanRecord, reached: NDArray[np.float32] | None) -> str:
    """The error of f after the last executed push: the largest distance over the objects, for a title."""
    predicted = record.plan.predicted_centers[0].numpy()
    if reached is None or len(reached) == 0 or len(predicted) < len(reached):
        return ""
    objects = predicted.shape[1]
    off = np.linalg.norm(predicted[len(reached) - 1] - reached[-1, :objects], axis=-1)[record.mask[:objects]]
    return f", prediction {100 * off.max():.1f} cm off" if len(off) and np.isfinite(off).all() else ""


def draw_end(panel: Axes, episode: Episode, task: Task, camera: Camera | None) -> None:
    """Draw the last observation and the objects' paths, with the outcome as the title."""
    first, last = episode.plan_records[0], episode.plan_records[-1]
    view = _draw_ground(panel, task, camera, episode.photograph, episode.observation, last.mask)
    centers = np.array([transition.centers for transition in episode.transitions], dtype=np.float32).reshape(
        -1, *first.centers.shape
    )
    draw_paths(panel, object_paths(first, centers, view))
    draw_objects(panel, centers[-1] if len(centers) else last.centers, last.mask, view)
    draw_places(panel, task, view)
    won = episode.outcome == "success"
    panel.set_title(
        f"end, after {counted(len(episode.transitions))}: {'success' if won else f'failure ({episode.outcome})'}",
        fontsize=10,
        fontweight="bold",
        color=SUCCESS_COLOR if won else FAILURE_COLOR,
    )


def _draw_ground(
    panel: Axes,
    task: Task,
    camera: Camera | None,
    photograph: NDArray[np.uint8] | None,
    observation: Mapping[str, NDArray[np.float32]] | None,
    mask: NDArray[np.bool_],
) -> View:
    """Draw the background, and return its projection."""
    view: View = Map()
    if camera is not None:
        view = camera if photograph is None else camera.resized(photograph.shape[1], photograph.shape[0])
    left, top, right, bottom = table_box(view)
    panel.set(xticks=[], yticks=[])
    if camera is not None and photograph is not None:
        panel.imshow(photograph)  # which shows the tiles
    else:
        panel.fill([left, right, right, left], [top, top, bottom, bottom], color=TABLE_COLOR, zorder=0)
        for group in task.tile_groups():
            fill = to_rgba(group.color, group.opacity)
            for tile in group.tiles:
                corners = tile_corners(tile, view)
                panel.add_patch(Polygon(corners, facecolor=fill, edgecolor=group.color, linewidth=1.4, zorder=1))
    if camera is None:
        mark_axes(panel, view)
        if observation is not None:
            for number in np.flatnonzero(mask):
                pixels = view.project(observation["clouds"][number])
                panel.scatter(pixels[:, 0], pixels[:, 1], s=1.5, color=COLORS[number], linewidths=0, zorder=1.5)
    panel.set_xlim(left - MARGIN, right + MARGIN)
    panel.set_ylim(bottom + MARGIN, top - MARGIN)  # rows count downwards
    panel.set_aspect("equal")
    panel.spines[:].set_visible(False)
    return view
