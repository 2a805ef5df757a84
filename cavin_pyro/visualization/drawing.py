"""The one drawing: a world's picture with a plan over it, in pictures of episodes, in films, and of imagined effects.

What is about a world, it says itself: `render`, `pixels`, `names`, `landmarks` and `arrows` of `World`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from cavin_pyro.envs.world import World
from cavin_pyro.evaluation.rollout import Episode, PlanRecord
from cavin_pyro.evaluation.statistics import counted
from cavin_pyro.visualization.training import DOTS_PER_INCH, save_figure

Floats = NDArray[np.floating]
Style = dict[str, Any]

PANELS = 3  # plans shown, besides the end
PANEL_WIDTH = 4.15  # inches; two fill a page's column
CANDIDATES = 150  # dots per plan
LONG = 30  # steps of a path, above which marks would cover it
SEGMENTS = 3  # of which subgoals are shown, at most
FONT = 10.0  # points, the only size
RING = 0.35  # times the farthest step of an object: the radius of the ring around the target

LEGEND: Style = {"fontsize": FONT, "frameon": False, "borderaxespad": 0.1}
LEGEND |= {"handlelength": 1.6, "handletextpad": 0.5, "columnspacing": 1.2}
_HALO = [withStroke(linewidth=2.8, foreground="white", alpha=0.85)]
# Distinguishable by colour-blind people (Okabe and Ito), and by shape.
CANDIDATE: Style = {"marker": "o", "markersize": 3.5, "color": "#5B3A8E", "linestyle": "", "markeredgewidth": 0}
SUBGOALS: Style = {"marker": "o", "markersize": 8, "color": "#E69F00", "linewidth": 2.2, "markeredgecolor": "black"}
PREDICTED: Style = {"marker": "x", "markersize": 6, "color": "#007A5A", "linewidth": 1.6, "markeredgewidth": 2}
REACHED: Style = {"marker": "D", "markersize": 4.5, "color": "#C5005E", "linewidth": 1.6}
TARGET: Style = {"color": "black", "linestyle": "--", "linewidth": 1.6}
ACTION: Style = {"marker": r"$\rightarrow$", "markersize": 13, "color": "black", "linestyle": ""}


class Observed(Protocol):
    """Centres [M, P] of the observed objects in the mask [M], where paths begin."""

    @property
    def centers(self) -> NDArray[np.float32]: ...

    @property
    def mask(self) -> NDArray[np.bool_]: ...


def draw_plan(panel: Axes, world: World, record: PlanRecord) -> None:
    """Draw candidates, the chosen subgoals, f's predictions and actions over a panel's picture."""
    plan, steps = record.plan, record.plan.actions.shape[1]
    dots, _ = candidate_subgoals(record, [0] if single_target(world) else named(world))
    if len(dots):
        x, y = project(world, dots).T
        colors = [to_rgba(CANDIDATE["color"], 0.08 + 0.5 * rank / len(dots)) for rank in range(len(dots))]
        panel.scatter(x, y, s=9, color=colors, linewidths=0, zorder=2)
    predicted = plan.predicted_centers[0].numpy()[:steps]
    draw_paths(panel, world, record, predicted, PREDICTED)
    segments = min(SEGMENTS, int(plan.segments[0]))
    draw_paths(panel, world, record, plan.subgoals.centers[0].numpy()[:segments], SUBGOALS)
    before = np.repeat(record.centers[None], steps, axis=0)
    if len(predicted) >= steps:
        before[1:, : predicted.shape[1]] = predicted[: steps - 1]
    _draw_actions(panel, world, world.arrows(plan.actions[0].numpy(), before))


def draw_paths(panel: Axes, world: World, record: Observed, centers: Floats, style: Style) -> None:
    """Draw the path of each named object that moves, from where it was observed through `centers: [n, M, P]`."""
    style = {**style, "marker": ""} if len(centers) > LONG else style
    for path in object_paths(world, record, centers).values():
        panel.plot(*project(world, path).T, **style, markevery=slice(1, None), path_effects=_HALO, zorder=4)


def object_paths(world: World, record: Observed, centers: Floats) -> dict[int, Floats]:
    """Paths [1 + n, P] of the named objects that move along `centers: [n, M, P]` by more than their scale.

    A plan may have fewer objects than the observation; the others are padding.
    """
    objects = centers.shape[1]
    ways = np.concatenate([record.centers[None, :objects], centers])
    furthest = np.linalg.norm(ways[..., :2] - ways[:1, :, :2], axis=-1).max(axis=0)
    moves = record.mask[:objects] & (furthest > world.space.center_scale) & np.isfinite(furthest)
    return {index: ways[:, index] for index in named(world) if index < objects and moves[index]}


def named(world: World) -> list[int]:
    """The objects that have a name, apart from a tool."""
    return [index for index, name in enumerate(world.names) if name]


def single_target(world: World) -> bool:
    """Whether the goal is about object 0 among others."""
    return len(named(world)) > 1 and world.goal().about == "target"


def candidate_subgoals(record: PlanRecord, objects: list[int], *, count: int = CANDIDATES) -> tuple[Floats, Floats]:
    """Some of the candidate subgoals of some objects.

    Returns positions [n, P] and returns [n] of their plans with n at most `count`, best last.
    """
    centers, returns = (part[0].numpy() for part in (record.plan.candidate_centers, record.plan.candidate_returns))
    points = centers[:, :, [index for index in objects if index < centers.shape[2]]]  # [N, K, objects, P]
    every = np.broadcast_to(returns[:, None, None], points.shape[:-1]).ravel()
    points = points.reshape(-1, points.shape[-1])
    finite = np.flatnonzero(np.isfinite(every) & np.isfinite(points).all(axis=-1))
    # A random choice: regular steps would select the same segment of every plan.
    chosen = np.random.default_rng(0).permutation(finite)[:count]
    chosen = chosen[np.argsort(every[chosen], kind="stable")]
    return points[chosen], every[chosen]


def draw_target(panel: Axes, world: World, centers: Floats) -> None:
    """Draw a ring around the target, object 0 of `centers: [M, P]`, and write the landmarks' names."""
    if single_target(world):
        angles = np.linspace(0.0, 2 * np.pi, 60, endpoint=False)
        ring = np.repeat(centers[:1], len(angles), axis=0)
        ring[:, :2] += RING * world.space.step_range * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        panel.add_patch(Polygon(project(world, ring), fill=False, path_effects=_HALO, zorder=5, **TARGET))
    for name, place in world.landmarks.items():
        x, y = project(world, place)
        panel.text(x, y, name, fontsize=FONT, ha="center", va="center", path_effects=_HALO, zorder=3, clip_on=True)


def draw_ground(panel: Axes, picture: NDArray[np.uint8] | None) -> None:
    """Show a world's picture without what is empty above, or axes where it has none."""
    panel.set_aspect("equal")
    if picture is not None:
        panel.imshow(picture)
        panel.set(xlim=(0, picture.shape[1]), ylim=(picture.shape[0], empty_rows(picture)), autoscale_on=False)
        panel.set_axis_off()


def empty_rows(picture: NDArray[np.uint8]) -> int:
    """How many rows of a picture [height, width, 3] are white from above."""
    return int((picture < 255).any(axis=(1, 2)).argmax())


def project(world: World, points: Floats) -> NDArray[np.float64]:
    """Positions [..., P] in a world's picture, or on axes where it has none: [..., 2]; the second is 0 if P is 1."""
    pixels = world.pixels(points)
    if pixels is None:
        pixels = np.concatenate([points, np.zeros_like(points[..., :1])], axis=-1)[..., :2]
    return np.asarray(pixels, dtype=np.float64)


def legend(world: World, records: list[PlanRecord]) -> list[Line2D]:
    """Entries for what `draw_plan` draws, and nothing else; at most six."""
    plans = [record.plan for record in records]
    still = np.repeat(records[0].centers[None], plans[0].actions.shape[1], axis=0)
    shown: Mapping[str, tuple[bool, Style]] = {
        "target": (single_target(world), TARGET),
        "candidates": (any(plan.candidate_centers.numel() for plan in plans), CANDIDATE),
        "subgoals": (any(plan.subgoals.centers.numel() for plan in plans), SUBGOALS),
        "predicted": (any(plan.predicted_centers.numel() for plan in plans), PREDICTED),
        "reached": (True, REACHED),
        world.step_names[0]: (world.arrows(plans[0].actions[0].numpy(), still) is not None, ACTION),
    }
    return [Line2D([], [], label=name, **style) for name, (drawn, style) in shown.items() if drawn]


def title(world: World, record: PlanRecord, total: int) -> str:
    """Which step of how many, and which object f expects to go farthest of those with a subgoal, in words."""
    said, plan = f"{world.step_names[0]} {record.step + 1} of {total}", record.plan
    subgoals = object_paths(world, record, plan.subgoals.centers[0].numpy()[:1])
    predicted = object_paths(world, record, plan.predicted_centers[0].numpy()[: plan.actions.shape[1]])
    moves = {index: float(np.linalg.norm(path[-1] - path[0])) for index, path in predicted.items() if index in subgoals}
    return f"{said}: the {world.names[max(moves, key=moves.__getitem__)]} goes to the orange mark" if moves else said


def ending(world: World, episode: Episode) -> str:
    """How an episode ended: `success after 6 pushes`."""
    return f"{episode.outcome} after {counted(len(episode.transitions), *world.step_names)}"


def trail(episode: Episode, count: int) -> Floats:
    """Centres after each of the first `count` steps: [count, M, P]."""
    centers = [one.centers for one in episode.transitions[:count]]
    return np.array(centers, dtype=np.float32).reshape(-1, *episode.plan_records[0].centers.shape)


def draw_episode(path: Path, episode: Episode, world: World) -> None:
    """Draw at most three plans, evenly spread and in temporal order, and the end, without what a planner lacks.

    `episode`: its plans hold pictures, if the world has any. `world`: in which it ended; its goal is still the
    episode's.
    """
    count = len(episode.plan_records)
    chosen = [episode.plan_records[i] for i in np.linspace(0, count - 1, min(PANELS, count)).round().astype(int)]
    figure, panels = panels_of(len(chosen) + 1, episode.photograph)
    total = len(episode.transitions)
    for panel, record in zip(panels, chosen, strict=False):
        draw_ground(panel, record.photograph)
        draw_plan(panel, world, record)
        draw_paths(panel, world, record, episode.reached(record), REACHED)
        draw_target(panel, world, record.centers)
        panel.set_title(title(world, record, total), fontsize=FONT)
    first, end, centers = episode.plan_records[0], panels[len(chosen)], trail(episode, total)
    draw_ground(end, episode.photograph)
    draw_paths(end, world, first, centers, REACHED)
    draw_target(end, world, centers[-1] if total else first.centers)
    if world.space.positions == 1 and episode.photograph is None:  # a line
        for panel in panels:
            panel.set(aspect="auto", yticks=[])
    end.set_title(f"{world.name}, seed {episode.seed}: {ending(world, episode)}", fontsize=FONT, fontweight="bold")
    finish(path, figure, legend(world, chosen))


def panels_of(count: int, picture: NDArray[np.uint8] | None) -> tuple[Figure, list[Axes]]:
    """A figure with `count` panels in two columns, each in the proportions of a picture; without one, on equal axes."""
    rows, columns = -(-count // 2), min(2, count)
    height, width = (3, 4) if picture is None else (len(picture) - empty_rows(picture), picture.shape[1])
    size = (columns * PANEL_WIDTH, 0.35 + rows * (0.3 + PANEL_WIDTH * height / width))
    figure = Figure(figsize=size, dpi=DOTS_PER_INCH)
    figure.set_layout_engine("constrained", w_pad=0.02, h_pad=0.02)
    panels = list(figure.subplots(rows, columns, squeeze=False, sharex=picture is None, sharey=picture is None).flat)
    for panel in panels[count:]:
        panel.set_axis_off()
    return figure, panels


def finish(path: Path, figure: Figure, handles: list[Line2D]) -> None:
    """Put the legend below, and write the picture."""
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), **LEGEND)
    save_figure(path, figure)


def _draw_actions(panel: Axes, world: World, arrows: Floats | None) -> None:
    """Arrows, the later the fainter: the first is executed in any case."""
    for number, (start, end) in enumerate([] if arrows is None else project(world, arrows), 1):
        arrow = {"arrowstyle": "-|>,head_width=0.35,head_length=0.6", "shrinkA": 0, "shrinkB": 0, "color": "black"}
        arrow |= {"linewidth": 2.4 / number, "alpha": 1 / number}
        panel.annotate("", end, start, arrowprops=arrow, zorder=6)
