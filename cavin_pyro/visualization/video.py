"""A video of an episode, with the current plan drawn over the frames."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from cavin_pyro.envs.tabletop.pushing import VIDEO_SIZE, ObservationDict, PushingEnv
from cavin_pyro.envs.tabletop.tasks import Task
from cavin_pyro.evaluation.rollout import Episode, EpisodeCallback, PlanRecord
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.visualization.plan import draw_overlay, return_scale
from cavin_pyro.visualization.training import DOTS_PER_INCH

FRAMES_PER_SECOND = 10
PAUSE = 0.5  # seconds for which a new plan is shown before its execution
CAPTION_HEIGHT = 22  # pixels
FORMAT: dict[str, Any] = {
    "format": "FFMPEG",
    "fps": FRAMES_PER_SECOND,
    "codec": "libx264",
    "pixelformat": "yuv420p",  # the only one that all browsers play
    "macro_block_size": 2,
    "output_params": ["-movflags", "+faststart"],
    "ffmpeg_log_level": "quiet",  # what fails is told in our own line
}


@contextmanager
def episode_video(path: Path, env: PushingEnv, task: Task) -> Iterator[EpisodeVideo]:
    """Yield a video of an episode; the H.264 file, which browsers play, takes its place at the end, atomically."""
    with atomic_write(path) as temporary:
        writer = imageio.get_writer(temporary, mode="I", **FORMAT)
        try:
            yield EpisodeVideo(writer, env, task)
        except OSError as error:  # from imageio, and without a number
            if error.errno is not None:
                raise
            raise OSError(errno.EIO, "ffmpeg stopped, is the disk full?", str(path)) from error
        finally:
            writer.close()


class EpisodeVideo(EpisodeCallback):
    """Appends photographs of an episode with an overlay to an open writer of frames; made by `episode_video`."""

    def __init__(self, writer: Any, env: PushingEnv, task: Task) -> None:
        self._writer, self._scene, self._task = writer, env.scene, task
        self.camera = env.scene.camera.resized(*VIDEO_SIZE)
        self._record: PlanRecord | None = None
        self._reached: list[NDArray[np.float32]] = []
        self._overlay: Image.Image | None = None
        self._font = ImageFont.load_default(14)

    def on_plan(self, record: PlanRecord) -> None:
        """Draw this plan over the frames that follow, and show its photograph, if any, for half a second."""
        self._record, self._reached, self._overlay = record, [], None
        if record.photograph is not None:
            self._add(record.photograph, "planned", repeat=round(PAUSE * FRAMES_PER_SECOND))

    def on_observation(self, observation: ObservationDict) -> None:
        """Draw the observed centres after a push over the frames that follow."""
        if self._record is not None:
            self._reached.append(observation["centers"])
            self._overlay = None

    def on_frame(self) -> None:
        self._add(self._scene.photograph(self.camera), "pushing")

    def on_end(self, episode: Episode) -> None:
        """Show the outcome for a second."""
        self._add(self._scene.photograph(self.camera), episode.outcome, repeat=FRAMES_PER_SECOND)

    def _add(self, frame: NDArray[np.uint8], phase: str, *, repeat: int = 1) -> None:
        """Append a photograph [H, W, 3] with overlay and caption."""
        image = Image.fromarray(np.ascontiguousarray(frame))
        if self._overlay is None:
            self._overlay = self._draw_overlay(*image.size)
        image.paste(self._overlay, mask=self._overlay)
        draw = ImageDraw.Draw(image)
        draw.rectangle((0, 0, image.width, CAPTION_HEIGHT), fill="white")
        draw.text((8, 3), self._caption(phase), fill="black", font=self._font)
        for _ in range(repeat):
            self._writer.append_data(np.asarray(image))

    def _caption(self, phase: str) -> str:
        if self._record is None:
            return f"{self._task.name} · {phase}"
        first = self._record.step + 1
        last = self._record.step + self._record.plan.actions.shape[1]
        numbers = f"push {first}" if first == last else f"pushes {first} to {last}"
        return f"{self._task.name} · {numbers} · {phase}"

    def _draw_overlay(self, width: int, height: int) -> Image.Image:
        """Everything that stays the same until the next push, as a transparent image."""
        figure = Figure(figsize=(width / DOTS_PER_INCH, height / DOTS_PER_INCH), dpi=DOTS_PER_INCH, facecolor="none")
        canvas = FigureCanvasAgg(figure)
        panel = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, width), ylim=(height, 0))
        panel.set_axis_off()
        if self._record is not None:
            scale = return_scale(self._record.plan.candidate_returns[0].numpy())
            reached = np.array(self._reached, dtype=np.float32).reshape(-1, *self._record.centers.shape)
            draw_overlay(panel, self._record, self._task, self.camera.resized(width, height), scale, reached)
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba()))
