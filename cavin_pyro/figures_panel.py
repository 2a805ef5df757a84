"""One decision, drawn over the photograph from above: a panel of the plan's figure, and the legend to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, Normalize, to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, Patch, Polygon
from matplotlib.patheffects import withStroke

from cavin_pyro.episodes import Decision
from cavin_pyro.figures_overlay import (
    PREDICTION_COLOR,
    PUSH_COLOR,
    SUBGOAL_COLOR,
    TABLE_COLOR,
    candidate_subgoals,
    observed_centers,
    predicted_paths,
    pushes,
    subgoal_chains,
    table_box,
    target_circle,
    tile_corners,
)
from envs.camera import Camera
from envs.layouts import Layout
from envs.markings import tile_groups

CANDIDATES = 150  # dots per panel
# Nothing else in the picture is purple. The palest part is cut off: it would be lost on the table.
RETURNS = ListedColormap(colormaps["Purples"](np.linspace(0.2, 1.0, 128)))
MARGIN = 8  # pixels around the table

Style = dict[str, Any]
_HALO = [withStroke(linewidth=2.8, foreground="white", alpha=0.85)]
_SEEN: Style = {
    "marker": "o",
    "markersize": 4.5,
    "color": "white",
    "markeredgecolor": "black",
    "linestyle": "",
}
_CANDIDATE: Style = {"marker": "o", "markersize": 3.5, "color": "#6A51A3", "linestyle": ""}
_SUBGOALS: Style = {"marker": "o", "markersize": 5.5, "color": SUBGOAL_COLOR, "linewidth": 2.2}
_SUBGOALS |= {"markeredgecolor": "black", "markeredgewidth": 0.7}
_PREDICTED: Style = {"marker": "x", "markersize": 4, "color": PREDICTION_COLOR, "linewidth": 1.2}
_PUSH: Style = {"arrowstyle": "-|>", "mutation_scale": 10, "shrinkA": 0, "shrinkB": 0, "linewidth": 1.4}
_TARGET: Style = {"color": PUSH_COLOR, "linestyle": "--", "linewidth": 1.5}


def draw_decision(panel: Axes, decision: Decision, layout: Layout, camera: Camera, scale: Normalize | None) -> None:
    """Draw what was seen, considered, chosen and will be done.

    Args:
        camera: that took the photograph, in any resolution.
        scale: of the candidates' returns; None leaves the candidates out.
    """
    if decision.photograph is not None:
        height, width = decision.photograph.shape[:2]
        camera = camera.resized(width, height)
        panel.imshow(decision.photograph)
    left, top, right, bottom = table_box(camera)
    if decision.photograph is None:  # photographs show the tiles
        panel.fill([left, right, right, left], [top, top, bottom, bottom], color=TABLE_COLOR, zorder=0)
        _draw_tiles(panel, layout, camera)
    if scale is not None:
        dots, returns = candidate_subgoals(decision, layout, camera, count=CANDIDATES)
        panel.scatter(dots[:, 0], dots[:, 1], s=9, c=returns, norm=scale, cmap=RETURNS, alpha=0.8, zorder=2)
    for path in predicted_paths(decision, camera):
        panel.plot(path[:, 0], path[:, 1], **_PREDICTED, path_effects=_HALO, zorder=3)
    for chain in subgoal_chains(decision, camera):
        panel.plot(chain[:, 0], chain[:, 1], **_SUBGOALS, markevery=slice(1, None), zorder=4)
    _draw_pushes(panel, decision, camera)
    _draw_objects(panel, decision, camera)
    panel.set_xlim(left - MARGIN, right + MARGIN)
    panel.set_ylim(bottom + MARGIN, top - MARGIN)  # rows count downwards
    panel.set(xticks=[], yticks=[], aspect="equal")
    panel.spines[:].set_visible(False)
    panel.set_title(f"after {counted(decision.step)}", fontsize=10)


def legend(layout: Layout, decisions: Sequence[Decision], *, candidates: bool) -> list[Line2D | Patch]:
    """An entry for everything that `draw_decision` drew, and for nothing else."""
    entries: list[Line2D | Patch] = [
        Patch(facecolor=to_rgba(group.color, group.opacity), edgecolor=group.color, label=group.name)
        for group in tile_groups(layout)
    ]
    entries.append(Line2D([], [], label="target", **_TARGET))
    entries.append(Line2D([], [], label="seen", **_SEEN))
    if candidates:
        entries.append(Line2D([], [], label="candidates", **_CANDIDATE))
    if any(decision.plan.subgoals.centers.shape[1] for decision in decisions):
        entries.append(Line2D([], [], label="subgoals", **_SUBGOALS))
    if any(decision.plan.predicted_centers.shape[1] for decision in decisions):
        entries.append(Line2D([], [], label="predicted", **_PREDICTED))
    arrow: Style = {"marker": r"$\rightarrow$", "markersize": 15, "color": PUSH_COLOR, "linestyle": ""}
    entries.append(Line2D([], [], label="push", **arrow))
    return entries


def counted(number: int) -> str:
    """`1 push`, `2 pushes`."""
    return f"{number} push" if number == 1 else f"{number} pushes"


def _draw_tiles(panel: Axes, layout: Layout, camera: Camera) -> None:
    for group in tile_groups(layout):
        fill = to_rgba(group.color, group.opacity)
        for tile in group.tiles:
            corners = tile_corners(tile, camera)
            panel.add_patch(Polygon(corners, facecolor=fill, edgecolor=group.color, linewidth=1.4, zorder=1))


def _draw_pushes(panel: Axes, decision: Decision, camera: Camera) -> None:
    """Arrows, numbered behind their starts in the order of execution."""
    for number, (start, end) in enumerate(pushes(decision, camera), 1):
        order = 6 - 0.1 * number  # earlier ones on top: pushes often follow one another along a line
        arrow = FancyArrowPatch(start, end, color=PUSH_COLOR, path_effects=_HALO, zorder=order, **_PUSH)
        panel.add_patch(arrow)
        x, y = start - 8 * (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)  # 8 pixels
        panel.text(x, y, str(number), ha="center", va="center", fontsize=8, path_effects=_HALO, zorder=7)


def _draw_objects(panel: Axes, decision: Decision, camera: Camera) -> None:
    centers = observed_centers(decision, camera)
    panel.plot(centers[:, 0], centers[:, 1], **_SEEN, zorder=6)
    if decision.mask[0]:
        center, radius = target_circle(decision, camera)
        panel.add_patch(Circle(center, radius, fill=False, path_effects=_HALO, zorder=6, **_TARGET))
