from __future__ import annotations

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.pushing import VIDEO_SIZE, PushingEnv
from cavin_pyro.envs.tabletop.sensors.camera import Camera
from cavin_pyro.evaluation.rollout import rollout
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.planning import RandomPlanner
from cavin_pyro.visualization.video import FRAMES_PER_SECOND, episode_video


def read(path: Path) -> list[NDArray[np.uint8]]:
    with imageio.get_reader(path) as reader:
        return [np.asarray(image) for image in reader]


def test_an_episode_is_filmed_from_the_first_push_to_the_last_as_browsers_play_it(tmp_path: Path) -> None:
    camera, path = Camera(position=(0.6, 0.0, 1.1)), tmp_path / "episode.mp4"
    env = PushingEnv(task="insertion", objects=2, maximum_steps=3, camera=camera, render_mode="rgb_array")
    with episode_video(path, env, env.task) as video:
        assert video.camera == camera.resized(*VIDEO_SIZE)
        env.geometry = PointNet()
        episode = rollout(env, RandomPlanner(action_dimension=4), seed=0, photograph=True, callbacks=[video])
    env.close()
    images = read(path)
    safe = sum(not transition.unsafe for transition in episode.transitions)
    assert safe > 0
    assert len(images) == 5 * len(episode.plan_records) + 8 * safe + FRAMES_PER_SECOND  # the end is shown for a second
    column, row = video.camera.project(np.array([0.595, -0.38, 0.0])).astype(int)
    red, _, blue = images[0][row, column].astype(int)
    assert red - blue > 100  # the goal is gold
    assert np.abs(images[0][:22].astype(int) - images[-1][:22]).max() > 100  # the caption
    with imageio.get_reader(path) as reader:
        about = reader.get_meta_data()
    assert (about["codec"], about["fps"]) == ("h264", FRAMES_PER_SECOND) and about["pix_fmt"].startswith("yuv420p")
    content = path.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")  # it begins before it is loaded
    assert [one.name for one in tmp_path.iterdir()] == ["episode.mp4"]
