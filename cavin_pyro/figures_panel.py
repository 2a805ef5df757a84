"""One decision, drawn over the photograph from above: a panel of the plan's figure, and the legend to it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, Patch, Polygon
from matplotlib.patheffects import withStroke

from cavin_pyro.episodes import Decision
from cavin_pyro.figures_overlay import (
    PREDICTION_COLOR,
    PUSH_COLOR,
    SUBGOAL_COLOR,
    TARGET_RADIUS,
    candidate_subgoals,
    observed_centers,
    on_table,
    predicted_paths,
    pushes,
    subgoal_chains,
    tile_corners,
    tile_groups,
)
from envs.camera import Camera
from envs.layouts import Layout
from envs.workspace import TABLE_HIGH, TABLE_LOW

CANDIDATES = 150  # dots per panel
RETURNS = "Purples"  # a scale of its own: nothing else in the picture is purple
MARGIN = 8  # pixels around the table
_HALO = [withStroke(linewidth=3.2, foreground="white", alpha=0.85)]


def draw_decision(
    panel: Axes, decision: Decision, layout: Layout, camera: Camera, scale: Normalize | None
) -> None:
    """Draw what was seen, considered, chosen and will be done.

    Args:
        camera: that took the photograph, in any resolution.
        scale: of the candidates' returns; None leaves the candidates out.
    """
    if decision.photograph is not None:
        height, width = decision.photograph.shape[:2]
        camera = camera.resized(width, height)
        panel.imshow(decision.photograph, interpolation="antialiased")
    corners = on_table(np.array([TABLE_HIGH, TABLE_LOW]), camera)
    if decision.photograph is None:
        panel.fill(corners[[0, 0, 1, 1], 0], corners[[0, 1, 1, 0], 1], color="#C2B9AD", zorder=0)
    _draw_tiles(panel, layout, camera)
    if scale is not None:
        dots, returns = candidate_subgoals(decision, layout, camera, count=CANDIDATES)
        panel.scatter(*dots.T, c=returns, norm=scale, cmap=RETURNS, s=9, alpha=0.8, linewidths=0, zorder=2)
    for path in predicted_paths(decision, camera):
        line = {"color": PREDICTION_COLOR, "linewidth": 1.2, "marker": "x", "markersize": 4}
        panel.plot(*path.T, **line, path_effects=_HALO, zorder=3)
    for chain in subgoal_chains(decision, camera):
        line = {"color": SUBGOAL_COLOR, "linewidth": 2.2, "marker": "o", "markersize": 5.5}
        panel.plot(
            *chain.T, **line, markeredgecolor="black", markeredgewidth=0.7, markevery=slice(1, None), zorder=4
        )
    _draw_pushes(panel, decision, camera)
    _draw_objects(panel, decision, camera)
    panel.set(
        xlim=(corners[0, 0] - MARGIN, corners[1, 0] + MARGIN),
        ylim=(corners[1, 1] + MARGIN, corners[0, 1] - MARGIN),
    )
    panel.set(xticks=[], yticks=[], aspect="equal")
    panel.spines[:].set_visible(False)
    panel.set_title(f"after {counted(decision.step)}", fontsize=10)


def legend(layout: Layout, decisions: Sequence[Decision], *, candidates: bool) -> list[Line2D | Patch]:
    """An entry for everything that `draw_decision` drew, and for nothing else."""
    entries: list[Line2D | Patch] = [
        Patch(facecolor=to_rgba(group.color, group.opacity), edgecolor=group.color, label=group.name)
        for group in tile_groups(layout)
    ]
    entries.append(Line2D([], [], color=PUSH_COLOR, linestyle="--", linewidth=1.5, label="target"))
    entries.append(_entry("seen", "white", marker="o", markersize=5, markeredgecolor="black", linestyle=""))
    if candidates:
        entries.append(_entry("candidates", "#6A51A3", marker="o", markersize=3.5, linestyle=""))
    if any(decision.plan.subgoals.centers.shape[1] for decision in decisions):
        entries.append(_entry("subgoals", SUBGOAL_COLOR, marker="o", linewidth=2, markeredgecolor="black"))
    if any(decision.plan.predicted_centers.shape[1] for decision in decisions):
        entries.append(_entry("predicted", PREDICTION_COLOR, marker="x", markersize=4, linewidth=1.2))
    entries.append(_entry("push", PUSH_COLOR, marker=r"$\rightarrow$", markersize=15, linestyle=""))
    return entries


def counted(number: int) -> str:
    """`1 push`, `2 pushes`."""
    return f"{number} push" if number == 1 else f"{number} pushes"


def _entry(label: str, color: str, **style: str | float) -> Line2D:
    return Line2D([], [], color=color, label=label, **style)  # type: ignore[arg-type]


def _draw_tiles(panel: Axes, layout: Layout, camera: Camera) -> None:
    for group in tile_groups(layout):
        fill = to_rgba(group.color, group.opacity)
        for tile in group.tiles:
            corners = tile_corners(tile, camera)
            panel.add_patch(Polygon(corners, facecolor=fill, edgecolor=group.color, linewidth=1.4, zorder=1))


def _draw_pushes(panel: Axes, decision: Decision, camera: Camera) -> None:
    for number, (start, end) in enumerate(pushes(decision, camera), 1):
        style = {"arrowstyle": "-|>", "mutation_scale": 11, "shrinkA": 0, "shrinkB": 0, "linewidth": 1.8}
        panel.add_patch(FancyArrowPatch(start, end, color=PUSH_COLOR, path_effects=_HALO, zorder=5, **style))
        length = max(np.linalg.norm(end - start), 1e-6)
        behind = start - 8 * (end - start) / length  # pixels
        panel.text(*behind, str(number), ha="center", va="center", fontsize=8, path_effects=_HALO, zorder=7)


def _draw_objects(panel: Axes, decision: Decision, camera: Camera) -> None:
    panel.scatter(
        *observed_centers(decision, camera).T,
        s=20,
        color="white",
        edgecolors="black",
        linewidths=0.9,
        zorder=6,
    )
    if decision.mask[0]:
        center = camera.project(decision.centers[0])
        radius = TARGET_RADIUS * camera.focal_length / camera.position[2]
        panel.add_patch(
            Circle(
                center,
                radius,
                fill=False,
                color=PUSH_COLOR,
                linestyle="--",
                linewidth=1.5,
                path_effects=_HALO,
                zorder=6,
            )
        )
