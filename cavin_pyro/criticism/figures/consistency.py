"""Figures of subgoals, predictions, and the states that the pushes led to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from cavin_pyro.criticism.statistics.consistency import wanted_distances
from cavin_pyro.criticism.subgoal_rollout import SubgoalRollout
from cavin_pyro.visualization.overlay import PREDICTION_COLOR, PUSH_COLOR, SUBGOAL_COLOR, on_table, table_box
from envs.sensors.camera import Camera
from envs.workspace import push_endpoints

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
REACHED_COLOR = "#7B2FBE"
EXAMPLES = 6
_HALO = [withStroke(linewidth=2.6, foreground="white", alpha=0.85)]
_MARKS = {  # of an example: name, marker, colour
    "subgoal": ("o", SUBGOAL_COLOR),
    "f's prediction": ("X", PREDICTION_COLOR),
    "reached": ("D", REACHED_COLOR),
}

Floats = NDArray[np.floating]


def draw_distances(named: Mapping[str, Sequence[SubgoalRollout]], best: str, threshold: float) -> Figure:
    """How far from the subgoal objects end: cumulative, and against how far they were to move."""
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    distances = {name: wanted_distances(rollouts, threshold) for name, rollouts in named.items()}
    for color, (name, (_, end, _, _)) in zip(COLORS, distances.items(), strict=False):
        _cumulative(left, end, color=color, label=name)
    for style, effect in zip(("--", ":"), dict.fromkeys(name.partition(",")[0] for name in named), strict=False):
        first = next(rows[0] for name, rows in distances.items() if name.startswith(effect))
        _cumulative(left, first, color="#888888", linestyle=style, linewidth=1.2, label=f"{effect}, nothing moves")
    left.set(xlabel="distance to the subgoal (cm)", ylabel="share of objects", xlim=(0, 30), ylim=(0, 1))
    left.legend(fontsize=8, frameon=False, loc="lower right")
    first, end = 100 * distances[best][:2]
    limit = max(20.0, 1.05 * float(max(first.max(initial=0), end.max(initial=0))))
    right.plot([0, limit], [0, limit], color="#999999", linewidth=1, linestyle="--")
    right.scatter(first, end, s=14, color=COLORS[list(named).index(best)], alpha=0.6, linewidths=0)
    right.set(xlabel="before (cm)", ylabel="after (cm)", xlim=(0, limit), ylim=(0, limit), aspect="equal")
    for panel in (left, right):
        _plain(panel)
    return figure


def draw_split(named: Mapping[str, Sequence[SubgoalRollout]], threshold: float) -> Figure:
    """Mean distances: subgoal to prediction, prediction to reached, subgoal to reached, and if nothing moved."""
    figure = Figure(figsize=(9.0, 0.9 + 0.75 * len(named)), layout="constrained")
    panel = figure.subplots()
    bars = {
        "subgoal to f's prediction": (2, PREDICTION_COLOR),
        "f's prediction to reached": (3, REACHED_COLOR),
        "subgoal to reached": (1, SUBGOAL_COLOR),
        "subgoal to start": (0, "#BBBBBB"),
    }
    for number, rollouts in enumerate(named.values()):
        distances = 100 * wanted_distances(rollouts, threshold)
        for place, (label, (row, color)) in enumerate(bars.items()):
            value = float(distances[row].mean()) if distances.shape[1] else 0.0
            height = number + 0.2 * (place - 1.5)
            panel.barh(height, value, 0.18, color=color, label=label if number == 0 else None)
            panel.text(value, height, f" {value:.1f}", va="center", fontsize=7)
    panel.set_yticks(range(len(named)), list(named), fontsize=9)
    panel.invert_yaxis()
    panel.set_xlabel("mean over objects that are to move (cm)")
    figure.legend(loc="outside upper center", ncols=len(bars), fontsize=8, frameon=False)
    _plain(panel)
    return figure


def draw_prediction(named: Mapping[str, Sequence[SubgoalRollout]]) -> Figure:
    """How far each object moved in physics against how far f says."""
    columns = min(3, len(named))
    rows = -(-len(named) // columns)
    figure = Figure(figsize=(3.0 * columns + 0.6, 3.2 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for panel in panels.flat[len(named) :]:
        panel.set_axis_off()
    for panel, color, (name, rollouts) in zip(panels.flat, COLORS, named.items(), strict=False):
        finished = [rollout for rollout in rollouts if not rollout.fallen and not rollout.hidden]
        predicted_moves = [np.linalg.norm(rollout.plan.predicted - rollout.before, axis=-1) for rollout in finished]
        moved = [np.linalg.norm(rollout.reached - rollout.before, axis=-1) for rollout in finished]
        points = 100 * np.stack([np.concatenate([[], *predicted_moves]), np.concatenate([[], *moved])])
        panel.plot([0, 30], [0, 30], color="#999999", linewidth=1, linestyle="--")
        panel.scatter(*points, s=9, color=color, alpha=0.5, linewidths=0)
        panel.set(xlim=(-0.5, 30), ylim=(-0.5, 30), aspect="equal")
        panel.set_title(name.replace(", ", ",\n"), fontsize=9)
        _plain(panel)
    figure.supxlabel("by f (cm)", fontsize=9)
    figure.supylabel("moved in physics (cm)", fontsize=9)
    return figure


def draw_examples(rollouts: Sequence[SubgoalRollout], threshold: float) -> Figure:
    """Scenes over the whole range of errors: the subgoal, f's prediction, the pushes and where objects came to lie."""
    eventful = [rollout for rollout in rollouts if (_distances(rollout)[0] > threshold).any()] or rollouts
    ranked = sorted(eventful, key=lambda rollout: (_error(rollout), rollout.scene))
    chosen = np.linspace(0, len(ranked) - 1, min(EXAMPLES, len(ranked))).round().astype(int)
    columns = min(3, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(max(5.0, 3.4 * columns), 0.5 + 2.5 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for panel in axes.flat[len(chosen) :]:
        panel.set_axis_off()
    for panel, number in zip(axes.flat, chosen, strict=False):
        _draw_example(panel, ranked[number], threshold)
    handles = [
        Line2D([], [], marker=marker, color=color, markeredgecolor="white", markersize=7, linestyle="", label=name)
        for name, (marker, color) in _MARKS.items()
        if name != "subgoal" or rollouts[0].plan.subgoal is not None
    ]
    handles.append(Line2D([], [], marker=r"$\rightarrow$", markersize=15, color=PUSH_COLOR, linestyle="", label="push"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False)
    return figure


def _distances(rollout: SubgoalRollout) -> Floats:
    """Distances [2, M] metres to the subgoal, or to f's prediction where there is none: before and after."""
    aim = rollout.plan.predicted if rollout.plan.subgoal is None else rollout.plan.subgoal
    return np.stack([np.linalg.norm(aim - state, axis=-1) for state in (rollout.before, rollout.reached)])


def _error(rollout: SubgoalRollout) -> float:
    """Largest distance of an object from where it should be at the end."""
    return float(_distances(rollout)[1].max())


def _draw_example(panel: Axes, rollout: SubgoalRollout, threshold: float) -> None:
    height, width = rollout.photograph.shape[:2]
    camera = Camera().resized(width, height)
    panel.imshow(rollout.photograph)
    plan = rollout.plan
    ends = [plan.predicted, rollout.reached] + ([] if plan.subgoal is None else [plan.subgoal])
    moving = np.max([np.linalg.norm(end - rollout.before, axis=-1) for end in ends], axis=0) > threshold
    for name, end in (("subgoal", plan.subgoal), ("f's prediction", plan.predicted), ("reached", rollout.reached)):
        if end is None:
            continue
        marker, color = _MARKS[name]
        for before, after in zip(camera.project(rollout.before[moving]), camera.project(end[moving]), strict=True):
            panel.plot(*zip(before, after, strict=True), color=color, linewidth=1.4, path_effects=_HALO)
            panel.plot(*after, marker=marker, color=color, markeredgecolor="white", markersize=7)
    for number, (start, stop) in enumerate(zip(*push_endpoints(plan.actions), strict=True), 1):
        first, last = on_table(np.stack([start, stop]), camera)
        panel.add_patch(
            FancyArrowPatch(first, last, arrowstyle="-|>", mutation_scale=8, shrinkA=0, shrinkB=0, color=PUSH_COLOR)
        )
        panel.text(
            float(first[0]), float(first[1]), f"{number}", ha="center", va="center", fontsize=7, path_effects=_HALO
        )
    left, top, right, bottom = table_box(camera)
    panel.set(xlim=(left - 4, right + 4), ylim=(bottom + 4, top - 4), xticks=[], yticks=[], aspect="equal")
    panel.spines[:].set_visible(False)
    notes = [f"{rollout.unsafe} unsafe"] * (rollout.unsafe > 0) + ["fell"] * rollout.fallen
    notes += ["hidden"] * (rollout.hidden and not rollout.fallen)
    panel.set_title(", ".join([f"scene {rollout.scene}: {100 * _error(rollout):.1f} cm", *notes]), fontsize=8)


def _cumulative(panel: Axes, metres: Floats, **style: Any) -> None:
    values = np.sort(100 * metres)
    shares = np.arange(1, len(values) + 1) / max(1, len(values))
    panel.step(np.concatenate([[0], values]), np.concatenate([[0], shares]), where="post", **style)


def _plain(panel: Axes) -> None:
    panel.grid(color="#E4E4E4", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8)
