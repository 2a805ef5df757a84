from __future__ import annotations

import subprocess
import time
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from imageio_ffmpeg import get_ffmpeg_exe
from numpy.typing import NDArray

from cavin_pyro.evaluation.rollout import PlanRecord, rollout
from cavin_pyro.visualization.video import EpisodeVideo
from envs.layouts import load_task
from envs.pushing import VIDEO_SIZE, PushingEnv
from envs.sensors.camera import Camera
from models.networks.pointnet import PointNet
from models.state import State
from planning import RandomPlanner

LAYOUT = load_task("insertion", 0)


def frame(height: int = 424, width: int = 512, grey: int = 200) -> NDArray[np.uint8]:
    return np.full((height, width, 3), grey, dtype=np.uint8)


def record(*, photograph: bool = False, step: int = 0) -> PlanRecord:
    """Of a plan that moves one object by 20 cm."""
    centers = torch.tensor([[[0.5, 0.1, 0.03]]])
    state = State(centers, torch.ones(1, 1, 64), torch.ones(1, 1, dtype=torch.bool))
    plan = RandomPlanner().plan(state, [torch.Generator().manual_seed(0)])
    there = state.map(lambda field: field[:, None].clone())
    there.centers[..., 0] += 0.2
    plan = plan._replace(subgoals=there, segments=torch.tensor([1]))
    picture = frame() if photograph else None
    return PlanRecord(step, centers[0].numpy(), np.array([True]), plan, 20.0, picture)


def read(path: Path) -> list[NDArray[np.uint8]]:
    with imageio.get_reader(path) as reader:
        return [np.asarray(image) for image in reader]


def test_a_video_holds_the_frames_that_were_added(tmp_path: Path) -> None:
    with EpisodeVideo(tmp_path / "episode.mp4", LAYOUT) as video:
        for number in range(12):
            video.add(frame(grey=20 * number))
        video.add(frame(), phase="success", repeat=5)
    images = read(tmp_path / "episode.mp4")
    assert len(images) == 17
    assert images[0].shape == (424, 512, 3)
    corner = [image[-10, 10].mean() for image in images[:12]]  # where nothing is drawn over
    np.testing.assert_allclose(corner, 20 * np.arange(12), atol=6)
    assert [path.name for path in tmp_path.iterdir()] == ["episode.mp4"]


def test_browsers_can_play_it_and_begin_before_it_is_loaded(tmp_path: Path) -> None:
    path = tmp_path / "episode.mp4"
    with EpisodeVideo(path, LAYOUT, fps=20) as video:
        video.add(frame(), repeat=20)
    with imageio.get_reader(path) as reader:
        about = reader.get_meta_data()
    assert (about["codec"], about["fps"], about["duration"]) == ("h264", 20.0, 1.0)
    assert about["pix_fmt"].startswith("yuv420p")
    content = path.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")


def test_odd_sizes_are_made_even(tmp_path: Path) -> None:
    with EpisodeVideo(tmp_path / "episode.mp4", LAYOUT) as video:
        video.add(frame(213, 257), repeat=3)
    assert [image.shape for image in read(tmp_path / "episode.mp4")] == [(212, 256, 3)] * 3


def test_the_plan_is_drawn_over_the_frames_that_follow_it(tmp_path: Path) -> None:
    with EpisodeVideo(tmp_path / "episode.mp4", LAYOUT) as video:
        video.add(frame(), repeat=2)
        video.on_plan(record())
        video.add(frame(), repeat=2)
    before, _, after, _ = (image.astype(int) for image in read(tmp_path / "episode.mp4"))
    column, row = video.camera.resized(512, 424).project(np.array([0.6, 0.1, 0.03])).round().astype(int)
    red, _, blue = after[row, column]
    assert red - blue > 100  # the chain is orange
    assert np.ptp(before[row, column]) < 20
    assert np.abs(before[:22] - after[:22]).max() > 100  # the caption


def test_a_plan_with_a_photograph_is_shown_for_half_a_second(tmp_path: Path) -> None:
    with EpisodeVideo(tmp_path / "episode.mp4", LAYOUT, fps=10) as video:
        video.on_plan(record(photograph=True))
        video.on_plan(record(step=3))
    assert len(read(tmp_path / "episode.mp4")) == 5


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt])
def test_a_crash_leaves_no_file_and_keeps_the_video_of_an_earlier_run(
    error: type[BaseException], tmp_path: Path
) -> None:
    with pytest.raises(error), EpisodeVideo(tmp_path / "new.mp4", LAYOUT) as video:
        video.add(frame())
        raise error
    assert not list(tmp_path.iterdir())
    (tmp_path / "old.mp4").write_bytes(b"old")
    with pytest.raises(error), EpisodeVideo(tmp_path / "old.mp4", LAYOUT) as video:
        video.add(frame())
        raise error
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


def test_a_video_that_misses_frames_is_an_error_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cavin_pyro.visualization.video.count_frames_and_secs", lambda path: (1, 0.1))
    with (
        pytest.raises(OSError, match="1 of 2 frames"),
        EpisodeVideo(tmp_path / "episode.mp4", LAYOUT) as video,
    ):
        video.add(frame(), repeat=2)
    assert not list(tmp_path.iterdir())


def test_a_video_without_frames_is_an_error_and_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no frame"), EpisodeVideo(tmp_path / "episode.mp4", LAYOUT):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "wrong", [np.zeros((424, 512), np.uint8), np.zeros((424, 512, 4), np.uint8), np.zeros((424, 512, 3))]
)
def test_what_is_not_a_frame_is_refused(wrong: NDArray, tmp_path: Path) -> None:
    with (
        pytest.raises(ValueError, match="a frame is"),
        EpisodeVideo(tmp_path / "episode.mp4", LAYOUT) as video,
    ):
        video.add(wrong)


def test_frames_are_refused_before_and_after_the_with_block(tmp_path: Path) -> None:
    video = EpisodeVideo(tmp_path / "episode.mp4", LAYOUT)
    with pytest.raises(RuntimeError, match="with block"):
        video.add(frame())
    with video:
        video.add(frame())
    with pytest.raises(RuntimeError, match="with block"):
        video.add(frame())


def test_drawing_over_a_frame_costs_little(tmp_path: Path) -> None:
    times = []
    with EpisodeVideo(tmp_path / "episode.mp4", LAYOUT) as video:
        video.on_plan(record())
        video._draw(frame(), "pushing")
        for _ in range(20):
            began = time.perf_counter()
            video._draw(frame(), "pushing")
            times.append(time.perf_counter() - began)
        video.add(frame())
    assert min(times) < 5e-3


def test_the_first_plan_is_drawn_as_the_environments_camera_sees_it(tmp_path: Path) -> None:
    camera = Camera(position=(0.6, 0.0, 1.4))
    env = PushingEnv(task="insertion", objects=2, camera=camera, render_mode="rgb_array")
    with EpisodeVideo(tmp_path / "episode.mp4", LAYOUT, env=env) as video:
        video.on_plan(record(photograph=True))
        assert video.camera == camera.resized(*VIDEO_SIZE)
    env.close()


def test_an_episode_is_filmed_from_the_first_push_to_the_last(tmp_path: Path) -> None:
    env = PushingEnv(task="insertion", objects=2, maximum_steps=4, render_mode="rgb_array")
    path = tmp_path / "episode.mp4"
    with EpisodeVideo(path, LAYOUT, env=env) as video:
        episode = rollout(env, RandomPlanner(), PointNet(), seed=0, photograph=True, callbacks=[video])
    env.close()
    images = read(path)
    safe = sum(not transition.unsafe for transition in episode.transitions)
    assert safe > 0
    assert len(images) == 5 * len(episode.plan_records) + 8 * safe + video.fps  # the end is shown for a second
    column, row = video.camera.project(np.array([0.595, -0.38, 0.0])).astype(int)
    red, _, blue = images[0][row, column].astype(int)
    assert red - blue > 100  # the goal is gold
    checked = subprocess.run(
        [get_ffmpeg_exe(), "-v", "error", "-i", str(path), "-f", "null", "-"], capture_output=True, check=True
    )
    assert checked.stderr == b""
