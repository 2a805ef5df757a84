from __future__ import annotations

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.evaluation.rollout import Episode, rollout
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.planning import RandomPlanner
from cavin_pyro.visualization.video import FRAMES_PER_SECOND, HEADER, LAST, PAUSE, Film


@pytest.fixture(scope="module")
def filmed() -> tuple[Film, Episode, NDArray[np.float64]]:
    """A film, its episode, and where the goal lies in its frames."""
    env = PushingEnv(task="insertion", objects=2, maximum_steps=3, render_mode="rgb_array")
    env.geometry, film = PointNet(), Film(env)
    episode = rollout(env, RandomPlanner(action_dimension=4), seed=0, photograph=True, callbacks=[film])
    goal = env.pixels(np.array([0.595, -0.38, 0.0])) + [0, HEADER - film.empty]
    env.close()
    return film, episode, goal


def test_an_episode_is_filmed_from_the_first_push_to_the_last_as_browsers_play_it(
    filmed: tuple[Film, Episode, NDArray[np.float64]], tmp_path: Path
) -> None:
    (film, episode, goal), path = filmed, tmp_path / "episode.mp4"
    film.write(path, episode)
    with imageio.get_reader(path) as reader:
        images, about = [np.asarray(image) for image in reader], reader.get_meta_data()
    safe = sum(not transition.unsafe for transition in episode.transitions)
    assert safe > 0
    assert len(images) == (PAUSE + 2) * len(episode.plan_records) + 8 * safe + LAST
    column, row = goal.astype(int)
    red, _, blue = images[0][row, column].astype(int)
    assert red - blue > 100  # the goal is gold
    assert np.abs(images[0][:HEADER].astype(int) - images[-1][:HEADER]).max() > 100  # the title
    assert (about["codec"], about["fps"]) == ("h264", FRAMES_PER_SECOND) and about["pix_fmt"].startswith("yuv420p")
    content = path.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")  # it begins before it is loaded
    assert [one.name for one in tmp_path.iterdir()] == ["episode.mp4"]


@pytest.mark.parametrize("ending", ["gif", "webp"])
def test_a_film_for_a_web_page_moves_without_end(
    ending: str, filmed: tuple[Film, Episode, NDArray[np.float64]], tmp_path: Path
) -> None:
    film, episode, _ = filmed
    film.write(tmp_path / f"episode.{ending}", episode)
    with Image.open(tmp_path / f"episode.{ending}") as image:
        image.load()
        assert image.n_frames > 8 and image.info["loop"] == 0
        assert image.info["duration"] == 100 * PAUSE
