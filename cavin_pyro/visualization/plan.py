"""The plans of an episode as a picture, over the camera's image or on a map.

It is the paper's qualitative figure, with the end of the episode as the last panel.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cavin_pyro.evaluation.rollout import Episode, PlanRecord
from cavin_pyro.visualization.overlay import TABLE_COLOR, View, reached_paths, table_box
from cavin_pyro.visualization.panel import (
    RETURNS,
    counted,
    draw_objects,
    draw_overlay,
    draw_paths,
    draw_places,
    draw_tiles,
    legend,
)
from cavin_pyro.visualization.table_map import Map, draw_clouds, mark_axes
from cavin_pyro.visualization.training import DOTS_PER_INCH, save_figure
from envs.sensors.camera import Camera
from envs.tasks import Task
from planning import Plan

PANELS = 5  # plans shown, besides the end
MARGIN = 8  # pixels around the table
SUCCESS_COLOR, FAILURE_COLOR = "#1B6E1B", "#C2272D"


def draw_plan(path: Path, episode: Episode, task: Task, camera: Camera | None) -> None:
    """Draw at most five plans, evenly spread and in temporal order, and the end.

    Parts that a planner lacks are omitted.

    Args:
        episode: its plans hold photographs and clouds, or an empty table is drawn.
        camera: that took the photographs, in any resolution; None draws maps from above instead, with the clouds.

    Raises:
        ValueError: the episode holds no plan.
    """
    if not episode.plan_records:
        raise ValueError("the episode holds no plan to draw: run it first")
    plan_records = spread_plans(episode)
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
        draw_return_scale(figure, scale, ax=axes, fraction=0.02, pad=0.01, aspect=30)
    figure.suptitle(
        f"{task.name}, seed {episode.seed}: {episode.outcome} after {counted(len(episode.transitions))}", fontsize=12
    )
    handles = legend(task, plan_records, candidates=scale is not None)
    entries = len(handles) if columns == 3 else -(-len(handles) // 2)
    figure.legend(handles=handles, loc="outside lower center", ncols=entries, fontsize=9, frameon=False)
    save_figure(path, figure)


def spread_plans(episode: Episode) -> list[PlanRecord]:
    """At most `PANELS` plans of an episode, evenly spread, the first and the last among them."""
    count = len(episode.plan_records)
    chosen = np.linspace(0, count - 1, min(PANELS, count)).round().astype(int)
    return [episode.plan_records[index] for index in chosen]


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
    view = _draw_ground(panel, task, camera, record.photograph, record.clouds, record.mask)
    draw_overlay(panel, record, task, view, scale, reached)
    about = evidence_text(record.plan)
    title = f"after {counted(record.step)}{record.prospect}{_error(record, reached)}"
    panel.set_title("\n".join([title, about] if about else [title]), fontsize=10)


def return_scale(returns: NDArray[np.float32]) -> Normalize | None:
    """A colour scale for the returns [n] that are finite; None where none is."""
    finite = returns[np.isfinite(returns)]
    if len(finite) == 0:
        return None
    low, high = float(finite.min()), float(finite.max())
    return Normalize(low, high if high > low else low + 1.0)


def draw_return_scale(figure: Figure, scale: Normalize, **place: Any) -> None:
    """Draw the colours of the candidates' returns; `place`: as in `Figure.colorbar`."""
    bar = figure.colorbar(ScalarMappable(scale, RETURNS), **place)
    bar.set_label("return of a candidate", fontsize=9)
    bar.ax.tick_params(labelsize=8)


def evidence_text(plan: Plan) -> str:
    """What planning as inference found, in one line; "" for a plan without it."""
    if plan.evidence is None:
        return ""
    log_z, temperature, sizes, particles = (field[0] for field in plan.evidence)
    fewest = f"{sizes.min():.0f} of {particles} effective"
    return f"log Z {log_z:.2f} at temperature {temperature:.3g}, {fewest}"


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
    view = _draw_ground(panel, task, camera, episode.photograph, episode.clouds, last.mask)
    centers = np.array([transition.centers for transition in episode.transitions], dtype=np.float32).reshape(
        -1, *first.centers.shape
    )
    draw_paths(panel, reached_paths(first, centers, view))
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
    clouds: NDArray[np.float32] | None,
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
        draw_tiles(panel, task, view)
    if camera is None:
        mark_axes(panel, view)
        if clouds is not None:
            draw_clouds(panel, clouds, mask, view)
    panel.set_xlim(left - MARGIN, right + MARGIN)
    panel.set_ylim(bottom + MARGIN, top - MARGIN)  # rows count downwards
    panel.set_aspect("equal")
    panel.spines[:].set_visible(False)
    return view
