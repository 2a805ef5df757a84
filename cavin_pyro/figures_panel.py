"""One decision, drawn over a photograph or a map: what pictures and videos share, and the legend to it."""

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

from cavin_pyro.episodes import Decision
from cavin_pyro.figures_overlay import (
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
from envs.layouts import Layout
from envs.markings import tile_groups

CANDIDATES = 150  # dots per panel
# Nothing else in the picture is purple. The palest part is cut off: it would be lost on the table.
RETURNS = ListedColormap(colormaps["Purples"](np.linspace(0.2, 1.0, 128)))

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
_OBSTACLES: Style = {**_SUBGOALS, "marker": "s", "markersize": 4.5, "color": OBSTACLE_COLOR, "linewidth": 1.6}
_PREDICTED: Style = {"marker": "x", "markersize": 4, "color": PREDICTION_COLOR, "linewidth": 1.2}
_REACHED: Style = {"marker": "D", "markersize": 3, "color": REACHED_COLOR, "linewidth": 1.2}
_PUSH: Style = {"arrowstyle": "-|>", "mutation_scale": 10, "shrinkA": 0, "shrinkB": 0, "linewidth": 1.4}
_TARGET: Style = {"color": PUSH_COLOR, "linestyle": "--", "linewidth": 1.5}


def draw_overlay(
    panel: Axes,
    decision: Decision,
    layout: Layout,
    view: View,
    scale: Normalize | None,
    reached: NDArray[np.float32] | None = None,
) -> None:
    """Draw what was seen, considered, chosen and will be done, over whatever the panel shows already.

    Args:
        scale: of the candidates' returns; None leaves the candidates out.
        reached: [n, M, 3] metres, centres seen after each push; None where they are not known yet.
    """
    if scale is not None:
        dots, returns = candidate_subgoals(decision, layout, view, count=CANDIDATES)
        panel.scatter(dots[:, 0], dots[:, 1], s=9, c=returns, norm=scale, cmap=RETURNS, alpha=0.8, zorder=2)
    for path in predicted_paths(decision, view).values():
        panel.plot(path[:, 0], path[:, 1], **_PREDICTED, path_effects=_HALO, zorder=3)
    for number, chain in subgoal_chains(decision, view).items():
        style = _SUBGOALS if number == 0 else _OBSTACLES
        panel.plot(chain[:, 0], chain[:, 1], **style, markevery=slice(1, None), zorder=4 if number == 0 else 3.5)
    _draw_pushes(panel, decision, view)
    if reached is not None:
        draw_paths(panel, reached_paths(decision, reached, view))
    draw_objects(panel, decision.centers, decision.mask, view)


def draw_paths(panel: Axes, paths: Mapping[int, Pixels]) -> None:
    """Draw where objects have really been, from where they were first seen."""
    for path in paths.values():
        panel.plot(path[:, 0], path[:, 1], **_REACHED, markevery=slice(1, None), path_effects=_HALO, zorder=6)


def draw_tiles(panel: Axes, layout: Layout, view: View) -> None:
    """Draw the task's region and goal."""
    for group in tile_groups(layout):
        fill = to_rgba(group.color, group.opacity)
        for tile in group.tiles:
            corners = tile_corners(tile, view)
            panel.add_patch(Polygon(corners, facecolor=fill, edgecolor=group.color, linewidth=1.4, zorder=1))


def draw_objects(panel: Axes, centers: NDArray[np.float32], mask: NDArray[np.bool_], view: View) -> None:
    """Draw where the objects [M, 3] metres, of which those in the mask [M] are real, are seen; the target is ringed."""
    pixels = view.project(centers[mask])
    panel.plot(pixels[:, 0], pixels[:, 1], **_SEEN, zorder=6)
    if mask[0]:
        center, radius = circle(centers[0], view)
        panel.add_patch(Circle(center, radius, fill=False, path_effects=_HALO, zorder=6, **_TARGET))


def legend(layout: Layout, decisions: Sequence[Decision], *, candidates: bool) -> list[Line2D | Patch]:
    """An entry for everything that `draw_overlay` draws of an episode, and for nothing else."""
    entries: list[Line2D | Patch] = [
        Patch(facecolor=to_rgba(group.color, group.opacity), edgecolor=group.color, label=group.name)
        for group in tile_groups(layout)
    ]
    entries.append(Line2D([], [], label="target", **_TARGET))
    entries.append(Line2D([], [], label="seen", **_SEEN))
    if candidates:
        entries.append(Line2D([], [], label="candidates", **_CANDIDATE))
    if any(decision.plan.subgoals.centers.shape[1] for decision in decisions):
        entries.append(Line2D([], [], label="target's subgoals", **_SUBGOALS))
        if any(decision.mask[1:].any() for decision in decisions):
            entries.append(Line2D([], [], label="obstacles' subgoals", **_OBSTACLES))
    if any(decision.plan.predicted_centers.shape[1] for decision in decisions):
        entries.append(Line2D([], [], label="predicted", **_PREDICTED))
    entries.append(Line2D([], [], label="reached", **_REACHED))
    arrow: Style = {"marker": r"$\rightarrow$", "markersize": 15, "color": PUSH_COLOR, "linestyle": ""}
    entries.append(Line2D([], [], label="push", **arrow))
    return entries


def counted(number: int) -> str:
    """`1 push`, `2 pushes`."""
    return f"{number} push" if number == 1 else f"{number} pushes"


def _draw_pushes(panel: Axes, decision: Decision, view: View) -> None:
    """Arrows, numbered behind their starts in the order of execution."""
    for number, (start, end) in enumerate(pushes(decision, view), 1):
        order = 6 - 0.1 * number  # earlier ones on top: pushes often follow one another along a line
        arrow = FancyArrowPatch(start, end, color=PUSH_COLOR, path_effects=_HALO, zorder=order, **_PUSH)
        panel.add_patch(arrow)
        x, y = start - 8 * (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)  # 8 pixels
        panel.text(x, y, str(number), ha="center", va="center", fontsize=8, path_effects=_HALO, zorder=7)
