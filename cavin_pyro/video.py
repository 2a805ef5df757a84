"""A video of an episode, with the plan that is being carried out drawn over it."""

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
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from cavin_pyro.episodes import Decision
from cavin_pyro.figures_overlay import (
    PUSH_COLOR,
    SUBGOAL_COLOR,
    Pixels,
    pushes,
    subgoal_chains,
)
from cavin_pyro.files import replacing
from envs.camera import Camera
from envs.pushing import VIDEO_SIZE, PushingEnv

FRAMES_PER_SECOND = 10
PAUSE = 0.5  # seconds for which a new plan is shown before it is carried out
CAPTION_HEIGHT = 22  # pixels
_FINE = 2  # the overlay is drawn this much larger, then shrunk, so that its edges are smooth


class EpisodeVideo:
    """Writes frames with an overlay to an H.264 video that browsers play; whole, or not at all.

    Use it as a context manager. Frames of odd sizes lose their last row or column, as the format wants.

    Args:
        path: `.mp4`. task: for the caption; the frames show its tiles themselves. fps: frames per second.
        camera: that takes the frames, in any resolution.
    """

    def __init__(self, path: Path, task: str, fps: int = FRAMES_PER_SECOND, *, camera: Camera | None = None) -> None:
        self.path, self.task, self.fps = path, task, fps
        self.camera = camera or Camera()
        self._decision: Decision | None = None
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

    def set_decision(self, decision: Decision) -> None:
        """Draw this plan over the frames to come, and show it for a moment if it has a photograph."""
        self._decision, self._overlay = decision, None
        if decision.photograph is not None:
            self.add(decision.photograph, phase="planned", repeat=max(1, round(PAUSE * self.fps)))

    def add(self, frame: NDArray[np.uint8], *, phase: str = "pushing", repeat: int = 1) -> None:
        """Append a frame [H, W, 3], drawn over.

        Args:
            phase: what is going on, for the caption. repeat: for how many frames it is shown.

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
        drawn = self._draw(frame, phase)
        try:
            for _ in range(repeat):
                self._writer.append_data(drawn)
        except OSError as error:  # from imageio, and without a number
            raise OSError(errno.EIO, "ffmpeg stopped, is the disk full?", str(self.path)) from error
        self._frames += repeat

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """An open writer, whose file takes its place at the end if all frames are in it."""
        with replacing(self.path) as temporary:
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
            if written != self._frames:  # ffmpeg does not tell when a disk is full at the end
                told = f"{written} of {self._frames} frames arrived, is the disk full?"
                raise OSError(errno.EIO, told, str(self.path))

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
        if self._decision is None:
            return f"{self.task} · {phase}"
        first = self._decision.step + 1
        last = self._decision.step + self._decision.plan.actions.shape[1]
        numbers = f"push {first}" if first == last else f"pushes {first} to {last}"
        return f"{self.task} · {numbers} · {phase}"

    def _draw_overlay(self, width: int, height: int) -> Image.Image:
        """Everything that stays the same until the next plan, as a transparent image."""
        camera = self.camera.resized(_FINE * width, _FINE * height)
        image = Image.new("RGBA", (camera.width, camera.height))
        draw = ImageDraw.Draw(image)
        if self._decision is not None:
            _draw_decision(draw, self._decision, camera)
        return image.resize((width, height), Image.Resampling.LANCZOS)


def film(env: PushingEnv, video: EpisodeVideo) -> None:
    """Have every push of the environment photographed for the video, from the environment's own camera."""
    camera = env.scene.camera.resized(*VIDEO_SIZE)
    video.camera = camera
    env.scene.on_frame = lambda: video.add(env.scene.photograph(camera))


def _open_writer(path: Path, fps: int) -> Any:
    options: dict[str, Any] = {
        "format": "FFMPEG",
        "fps": fps,
        "codec": "libx264",
        "pixelformat": "yuv420p",  # the only one that all browsers play
        "macro_block_size": 2,
        "output_params": ["-movflags", "+faststart"],
        "ffmpeg_log_level": "error",
    }
    return imageio.get_writer(path, mode="I", **options)


def _draw_decision(draw: ImageDraw.ImageDraw, decision: Decision, camera: Camera) -> None:
    for chain in subgoal_chains(decision, camera):
        draw.line(_points(chain), fill=SUBGOAL_COLOR, width=3 * _FINE, joint="curve")
        for column, row in chain[1:]:
            draw.circle((column, row), 4 * _FINE, fill=SUBGOAL_COLOR, outline="black", width=_FINE)
    for start, end in pushes(decision, camera):
        _draw_arrow(draw, start, end)


def _draw_arrow(draw: ImageDraw.ImageDraw, start: Pixels, end: Pixels) -> None:
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
    across = np.array([-along[1], along[0]])
    neck = end - 8 * _FINE * along
    draw.line(_points(np.stack([start, neck])), fill=PUSH_COLOR, width=2 * _FINE)
    draw.polygon(_points(np.stack([end, neck + 4 * _FINE * across, neck - 4 * _FINE * across])), fill=PUSH_COLOR)


def _points(pixels: Pixels) -> list[tuple[float, float]]:
    return [(float(column), float(row)) for column, row in pixels]
