"""A video of an episode, with the current plan drawn over the frames."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import imageio.v2 as imageio
import numpy as np
from imageio_ffmpeg import count_frames_and_secs
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from cavin_pyro.evaluation.rollout import Episode, EpisodeCallback, PlanRecord
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.visualization.panel import draw_overlay
from cavin_pyro.visualization.plan import return_scale
from cavin_pyro.visualization.training import DOTS_PER_INCH
from envs.pushing import VIDEO_SIZE, ObservationDict, PushingEnv
from envs.sensors.camera import Camera
from envs.tasks import Task

FRAMES_PER_SECOND = 10
PAUSE = 0.5  # seconds for which a new plan is shown before its execution
CAPTION_HEIGHT = 22  # pixels


class EpisodeVideo(EpisodeCallback):
    """Writes frames with an overlay to an H.264 video that browsers play, atomically.

    Use it as a context manager. Frames of odd sizes lose their last row or column, as the format wants.

    Args:
        path: `.mp4`. task: of the episode; the frames show its tiles themselves. fps: frames per second.
        env: of which `on_frame` and `on_end` take photographs, with its own camera.
    """

    def __init__(self, path: Path, task: Task, fps: int = FRAMES_PER_SECOND, *, env: PushingEnv | None = None) -> None:
        self.path, self.task, self.fps = path, task, fps
        self.camera = Camera() if env is None else env.scene.camera.resized(*VIDEO_SIZE)
        self._env = env
        self._record: PlanRecord | None = None
        self._reached: list[NDArray[np.float32]] = []
        self._overlay: Image.Image | None = None
        self._font = ImageFont.load_default(14)
        self._writer: Any = None
        self._frames = 0
        self._stack = ExitStack()

    def __enter__(self) -> EpisodeVideo:
        self._stack.enter_context(self._writing())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def on_plan(self, record: PlanRecord) -> None:
        """Draw this plan over the frames that follow, and show its photograph, if any, for half a second."""
        self._record, self._reached, self._overlay = record, [], None
        if record.photograph is not None:
            self.add(record.photograph, phase="planned", repeat=max(1, round(PAUSE * self.fps)))

    def on_observation(self, observation: ObservationDict) -> None:
        """Draw the observed centres after a push over the frames that follow."""
        if self._record is not None:
            self._reached.append(observation["centers"])
            self._overlay = None

    def on_frame(self) -> None:
        """Append a photograph of the environment."""
        self.add(self._photograph())

    def on_end(self, episode: Episode) -> None:
        """Show the outcome for a second."""
        self.add(self._photograph(), phase=episode.outcome, repeat=self.fps)

    def add(self, frame: NDArray[np.uint8], *, phase: str = "pushing", repeat: int = 1) -> None:
        """Append a frame [H, W, 3], drawn over.

        Args:
            phase: for the caption. repeat: for how many frames it is shown.

        Raises:
            ValueError: the frame is not an image, or of another size than the first one.
            OSError: the frame cannot be written.
            RuntimeError: outside the `with` block.
        """
        if self._writer is None:
            raise RuntimeError("add frames inside the video's with block")
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[-1] != 3:
            raise ValueError(f"a frame is [H, W, 3] of uint8, not {list(frame.shape)} of {frame.dtype}")
        frame = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
        image = self._draw(frame, phase)
        try:
            for _ in range(repeat):
                self._writer.append_data(image)
        except OSError as error:  # from imageio, and without a number
            raise OSError(errno.EIO, "ffmpeg stopped, is the disk full?", str(self.path)) from error
        self._frames += repeat

    def _photograph(self) -> NDArray[np.uint8]:
        if self._env is None:
            raise RuntimeError("this video was made without an environment: use add")
        return self._env.scene.photograph(self.camera)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """An open writer, whose file takes its place at the end if all frames are in it."""
        with atomic_write(self.path) as temporary:
            self._writer, self._frames = _open_writer(temporary, self.fps), 0
            try:
                yield
            finally:
                self._writer.close()
                self._writer = None
            if self._frames == 0:
                raise ValueError(f"no frame was added to {self.path}: add one, or leave the video out")
            try:
                written, _ = count_frames_and_secs(str(temporary))
            except RuntimeError:  # the file is no video
                written = 0
            if written != self._frames:  # ffmpeg does not report a full disk at the end
                message = f"{written} of {self._frames} frames arrived, is the disk full?"
                raise OSError(errno.EIO, message, str(self.path))

    def _draw(self, frame: NDArray[np.uint8], phase: str) -> NDArray[np.uint8]:
        """The frame [H, W, 3] with overlay and caption."""
        image = Image.fromarray(np.ascontiguousarray(frame))
        if self._overlay is None or self._overlay.size != image.size:
            self._overlay = self._draw_overlay(*image.size)
        image.paste(self._overlay, mask=self._overlay)
        draw = ImageDraw.Draw(image)
        draw.rectangle((0, 0, image.width, CAPTION_HEIGHT), fill="white")
        draw.text((8, 3), self._caption(phase), fill="black", font=self._font)
        return np.asarray(image)

    def _caption(self, phase: str) -> str:
        if self._record is None:
            return f"{self.task.name} · {phase}"
        first = self._record.step + 1
        last = self._record.step + self._record.plan.actions.shape[1]
        numbers = f"push {first}" if first == last else f"pushes {first} to {last}"
        return f"{self.task.name} · {numbers} · {phase}"

    def _draw_overlay(self, width: int, height: int) -> Image.Image:
        """Everything that stays the same until the next push, as a transparent image."""
        camera = self.camera.resized(width, height)
        figure = Figure(figsize=(width / DOTS_PER_INCH, height / DOTS_PER_INCH), dpi=DOTS_PER_INCH, facecolor="none")
        canvas = FigureCanvasAgg(figure)
        panel = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, width), ylim=(height, 0))
        panel.set_axis_off()
        if self._record is not None:
            scale = return_scale(self._record.plan.candidate_returns[0].numpy())
            reached = np.array(self._reached, dtype=np.float32).reshape(-1, *self._record.centers.shape)
            draw_overlay(panel, self._record, self.task, camera, scale, reached)
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba()))


def _open_writer(path: Path, fps: int) -> Any:
    options: dict[str, Any] = {
        "format": "FFMPEG",
        "fps": fps,
        "codec": "libx264",
        "pixelformat": "yuv420p",  # the only one that all browsers play
        "macro_block_size": 2,
        "output_params": ["-movflags", "+faststart"],
        "ffmpeg_log_level": "quiet",  # what fails is told in our own line
    }
    return imageio.get_writer(path, mode="I", **options)
