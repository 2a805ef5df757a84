"""A film of an episode, with the current plan drawn over its pictures: MP4, or GIF or WebP for web pages."""

from __future__ import annotations

import errno
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v2 as imageio
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from cavin_pyro.envs.world import World
from cavin_pyro.evaluation.rollout import Episode, EpisodeCallback, PlanRecord
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.visualization.drawing import (
    FONT,
    LEGEND,
    REACHED,
    draw_paths,
    draw_plan,
    draw_target,
    empty_rows,
    ending,
    legend,
    title,
    trail,
)

FRAMES_PER_SECOND = 10
PAUSE = 6  # frames for which a new plan is shown before its execution
LAST = 15  # frames for which the end is shown
HEADER, FOOTER = 34, 30  # pixels above and below the picture, for title and legend
SMALLEST = 400  # pixels of a frame's width
WIDTH = 6.6  # inches in which the legend fits
FORMAT: dict[str, Any] = {
    "format": "FFMPEG",
    "fps": FRAMES_PER_SECOND,
    "codec": "libx264",
    "pixelformat": "yuv420p",  # the only one that all browsers play
    "macro_block_size": 2,
    "output_params": ["-movflags", "+faststart"],
    "ffmpeg_log_level": "quiet",  # what fails is told in our own line
}


class Shot(NamedTuple):
    """A compressed picture, the plan under which it was taken, the steps before it, and how many frames it stays."""

    picture: bytes
    plan: int
    steps: int
    frames: int


class Film(EpisodeCallback):
    """Keeps a world's pictures of an episode; `write` draws over them when it is known how the episode ends.

    `empty`: rows above that no picture uses, which are left out.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self._shots: list[Shot] = []
        self._plans, self._steps = 0, -1  # the first observation is before the first step
        self.empty = sys.maxsize

    def on_plan(self, record: PlanRecord) -> None:
        self._plans += 1
        self._keep(PAUSE)

    def on_observation(self, observation: Any) -> None:
        self._steps += 1
        if self._steps:
            self._keep(2)

    def on_frame(self) -> None:
        self._keep(1)

    def on_end(self, episode: Episode) -> None:
        self._keep(LAST)

    def _keep(self, frames: int) -> None:
        picture = np.ascontiguousarray(self._world.render())
        self._size, self.empty = picture.shape, min(self.empty, empty_rows(picture))
        self._shots.append(Shot(zlib.compress(picture.tobytes(), 1), self._plans - 1, self._steps, frames))

    def write(self, path: Path, episode: Episode) -> None:
        """Write the file, whose ending says its format; it takes its place at the end, atomically."""
        with atomic_write(path) as temporary:
            if path.suffix == ".mp4":
                _write_mp4(temporary, self._frames(episode))
            else:
                pictures, times = zip(*self._frames(episode), strict=True)
                first, *rest = map(Image.fromarray, pictures)
                duration = [1000 * frames // FRAMES_PER_SECOND for frames in times]  # milliseconds
                first.save(
                    temporary, save_all=True, append_images=rest, duration=duration, loop=0, quality=80, method=4
                )

    @property
    def _shown(self) -> tuple[int, int]:
        """Columns and rows of the picture in a frame: a small one is enlarged."""
        rows, columns, _ = self._size
        factor = -(-SMALLEST // columns)
        return factor * columns, factor * (rows - self.empty)

    def _frames(self, episode: Episode) -> Iterator[tuple[NDArray[np.uint8], int]]:
        """Each frame [H, W, 3], and for how many frames it stays."""
        known = None
        for shot in self._shots:
            ended = shot is self._shots[-1]
            if known != (known := (shot.plan, shot.steps, ended)):
                overlay = self._overlay(episode, episode.plan_records[shot.plan], shot.steps, ended=ended)
            picture = np.frombuffer(zlib.decompress(shot.picture), np.uint8).reshape(self._size)[self.empty :]
            image = Image.new("RGB", overlay.size, "white")
            image.paste(Image.fromarray(picture).resize(self._shown, Image.Resampling.NEAREST), (0, HEADER))
            image.paste(overlay, mask=overlay)
            yield np.asarray(image), shot.frames

    def _overlay(self, episode: Episode, record: PlanRecord, steps: int, *, ended: bool) -> Image.Image:
        """Everything that stays the same until the next step, as a transparent image."""
        columns, rows = self._shown
        width, height = columns + columns % 2, rows + HEADER + FOOTER + rows % 2  # even, as yuv420p wants
        figure = Figure(figsize=(WIDTH, WIDTH * height / width), dpi=width / WIDTH, facecolor="none")
        canvas = FigureCanvasAgg(figure)
        box = (0.0, 1 - (HEADER + rows) / height, columns / width, rows / height)
        panel = figure.add_axes(box, xlim=(0, self._size[1]), ylim=(self._size[0], self.empty))
        panel.set_axis_off()
        if not ended:
            draw_plan(panel, self._world, record)
        centers = trail(episode, steps)
        draw_target(panel, self._world, centers[-1] if steps else record.centers)
        draw_paths(panel, self._world, episode.plan_records[0], centers, REACHED)
        said = ending(self._world, episode) if ended else title(self._world, record, len(episode.transitions))
        figure.text(0.5, 1 - HEADER / 2 / height, said, ha="center", va="center", fontsize=FONT + 1)
        handles = legend(self._world, episode.plan_records)
        figure.legend(handles=handles, loc="lower center", ncols=len(handles), **LEGEND)
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba()))


def _write_mp4(path: Path, frames: Iterator[tuple[NDArray[np.uint8], int]]) -> None:
    """H.264, which browsers play."""
    writer = imageio.get_writer(path, mode="I", **FORMAT)
    try:
        for frame, times in frames:
            for _ in range(times):
                writer.append_data(frame)
    except OSError as error:  # from imageio, and without a number
        if error.errno is not None:
            raise
        raise OSError(errno.EIO, "ffmpeg stopped, is the disk full?", str(path)) from error
    finally:
        writer.close()
