"""An episode of another world than the tabletop: a picture of its plans, a video, and a table of its steps."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from cavin_pyro.envs.world import World
from cavin_pyro.evaluation.evaluation import episode_row
from cavin_pyro.evaluation.factory import EpisodeRunner
from cavin_pyro.evaluation.rollout import Episode, EpisodeCallback, PlanRecord
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.visualization import plan as styles
from cavin_pyro.visualization.overlay import Pixels, object_paths
from cavin_pyro.visualization.training import DOTS_PER_INCH, save_figure
from cavin_pyro.visualization.video import FORMAT, FRAMES_PER_SECOND

PANELS = 5  # plans shown, besides the end


class WorldView:
    """Positions in a world's picture, or on axes where it has none."""

    def __init__(self, world: World) -> None:
        self._world = world

    def project(self, points: NDArray[np.floating]) -> Pixels:
        """`[..., 2]` of positions `[..., P]`; the second is 0 where P is 1."""
        pixels = self._world.pixels(points)
        if pixels is None:
            pixels = np.concatenate([points, np.zeros_like(points[..., :1])], axis=-1)[..., :2]
        return np.asarray(pixels, dtype=np.float64)


class Film(EpisodeCallback):
    """Appends the world's picture to an open writer, as often as the world calls `on_frame`, else after each step."""

    def __init__(self, world: World, writer: Any) -> None:
        self._world, self._writer = world, writer

    def on_observation(self, observation: Any) -> None:
        self.on_frame()

    def on_frame(self) -> None:
        self._writer.append_data(np.asarray(self._world.render()))


def render_world(runner: EpisodeRunner, folder: Path, *, seed: int, video: bool) -> dict[str, Any]:
    """Run one episode, and write `plan.png`, and with `video`, where the world has pictures, `episode.mp4`.

    Returns its results' row.
    """
    world = runner.env
    with ExitStack() as stack:
        callbacks: list[EpisodeCallback] = []
        if video and world.render_mode is not None:
            temporary = stack.enter_context(atomic_write(folder / "episode.mp4"))
            frames = {**FORMAT, "fps": FRAMES_PER_SECOND}
            callbacks.append(Film(world, stack.enter_context(imageio.get_writer(temporary, mode="I", **frames))))
        episode = runner.rollout(seed, photograph=True, callbacks=callbacks)
    draw_world(folder / "plan.png", episode, world)
    return episode_row(episode)


def draw_world(path: Path, episode: Episode, world: World) -> None:
    """Draw at most five plans in temporal order, and the end: candidates, subgoals, predictions, what was reached."""
    count = len(episode.plan_records)
    chosen = [episode.plan_records[i] for i in np.linspace(0, count - 1, min(PANELS, count)).round().astype(int)]
    columns = min(3, len(chosen) + 1)
    rows = -(-(len(chosen) + 1) // columns)
    figure = Figure(figsize=(3.4 * columns, 0.9 + 3.5 * rows), dpi=DOTS_PER_INCH, layout="constrained")  # inches
    axes = figure.subplots(rows, columns, squeeze=False)
    view, scale = WorldView(world), styles.return_scale(_returns(chosen))
    for panel, record in zip(axes.flat, chosen, strict=False):
        _ground(panel, record.photograph)
        if scale is not None:
            dots, returns = _candidates(record, view)
            panel.scatter(dots[:, 0], dots[:, 1], s=9, c=returns, norm=scale, cmap=styles.RETURNS, alpha=0.6, zorder=2)
        styles.draw_predictions(panel, record, view)
        styles.draw_paths(panel, object_paths(record, episode.reached(record), view))
        _objects(panel, record.centers[record.mask], view)
        panel.set_title(f"after {_counted(record.step)}{record.prospect.replace(', ', chr(10), 1)}", fontsize=10)
    first, end = chosen[0], axes.flat[len(chosen)]
    _ground(end, episode.photograph)
    centers = np.array([one.centers for one in episode.transitions]).reshape(-1, *first.centers.shape)
    styles.draw_paths(end, object_paths(first, centers, view))
    end.set_title(f"end, after {_counted(len(centers))}: {episode.outcome}", fontsize=10, fontweight="bold")
    for panel in axes.flat[len(chosen) + 1 :]:
        panel.set_axis_off()
    handles = [Line2D([], [], label=label, **style) for label, style in styles.SHOWN.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(6, 2 * columns), fontsize=9, frameon=False)
    figure.suptitle(f"{world.name}, seed {episode.seed}", fontsize=12)
    save_figure(path, figure)


def _counted(number: int) -> str:
    return f"{number} step" if number == 1 else f"{number} steps"


def _returns(records: list[PlanRecord]) -> NDArray[np.float32]:
    return np.concatenate([record.plan.candidate_returns[0].numpy() for record in records])


def _candidates(record: PlanRecord, view: WorldView) -> tuple[Pixels, NDArray[np.float32]]:
    """Some candidates' subgoals of object 0, best last, and the returns of their plans."""
    centers, returns = record.plan.candidate_centers[0, :, :, 0].numpy(), record.plan.candidate_returns[0].numpy()
    every = np.repeat(returns, centers.shape[1])
    finite = np.random.default_rng(0).permutation(np.flatnonzero(np.isfinite(every)))[: styles.CANDIDATES]
    chosen = finite[np.argsort(every[finite], kind="stable")]
    return view.project(centers.reshape(-1, centers.shape[-1])[chosen]), every[chosen]


def _objects(panel: Axes, centers: NDArray[np.float32], view: WorldView) -> None:
    pixels = view.project(centers)
    panel.plot(pixels[:, 0], pixels[:, 1], **styles.OBSERVED, zorder=6)


def _ground(panel: Axes, photograph: NDArray[np.uint8] | None) -> None:
    panel.set_aspect("equal")
    if photograph is not None:
        panel.imshow(photograph)
        panel.set(xlim=(0, photograph.shape[1]), ylim=(photograph.shape[0], 0), autoscale_on=False)
        panel.set_axis_off()
