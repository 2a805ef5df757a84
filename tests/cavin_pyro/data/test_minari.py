"""`python -m cavin_pyro.data export`, read back with Minari's own reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from cavin_pyro.data.dataset import read_metadata, read_shard, shard_path, write_metadata


def test_a_wrong_command_line_is_one_line(data: Callable, tmp_path: Path) -> None:
    for words in (["look", tmp_path], ["export", tmp_path], ["import", "minari:a-v0", "--to", tmp_path]):
        status, output, errors = data(*words)
        assert (status, output, errors.count("error:")) == (2, "", 1)
    assert not list(tmp_path.iterdir())


def test_minari_loads_every_episode(
    data: Callable, own_pushes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari", reason="Minari comes with the extras test and minari, from Python 3.11")
    monkeypatch.chdir(tmp_path)
    assert data("export", "pushes", "--to", "pushes-v0") == (0, "12 episodes in pushes-v0\n", "")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset("pushes-v0")
    assert dataset.total_steps == read_metadata(own_pushes)["transitions"]
    shards = [read_shard(shard_path(own_pushes, number)) for number in range(3)]
    arrays = {name: np.concatenate([one[name] for one in shards]) for name in shards[0]}
    told = dataset.storage.get_episode_metadata(range(12))
    for index, (episode, about) in enumerate(zip(dataset.iterate_episodes(), told, strict=True)):
        made = int(arrays["length"][index])
        for name in ("centers", "clouds", "visible"):
            assert np.array_equal(episode.observations[name], arrays[name][index, : made + 1]), name
        assert np.array_equal(episode.observations["mask"], np.tile(arrays["mask"][index], (made + 1, 1)))
        assert np.array_equal(episode.actions, arrays["actions"][index, :made])
        for name in ("moved", "unsafe", "ineffective", "fallen", "target", "angle"):
            assert np.array_equal(episode.infos[name], arrays[name][index, :made]), name
        assert np.array_equal(episode.terminations, arrays["fallen"][index, :made])
        assert (episode.terminations | episode.truncations).tolist() == [False] * (made - 1) + [True]
        assert (about["options"]["root_seed"], about["options"]["episode"]) == (3, arrays["episode"][index])
        assert np.array_equal(about["options"]["mass"], arrays["mass"][index])
        assert dataset.observation_space.contains({name: value[0] for name, value in episode.observations.items()})
    monkeypatch.delitem(gymnasium.registry, "cavin/Pushing-v0", raising=False)  # as in a process without our imports
    env = dataset.recover_environment()
    configuration = read_metadata(own_pushes)["configuration"]
    assert env.unwrapped.maximum_steps == configuration["steps"] and env.unwrapped.scene.slots == 5
    assert list(env.unwrapped.ranges.scale) == configuration["ranges"]["scale"]
    env.close()
    own = configuration | {"camera": {"_target_": "my_lab.Camera"}}
    write_metadata(own_pushes, {**read_metadata(own_pushes), "configuration": own})
    assert data("export", "pushes", "--to", "own-v0")[1].startswith("recover_environment() will not work: camera=")
    assert minari.load_dataset("own-v0").env_spec is None
    assert "holds a dataset already" in data("export", "pushes", "--to", "pushes-v0")[2]
    shard_path(own_pushes, 2).unlink()
    assert "episodes-00002.h5 is missing or corrupt" in data("export", "pushes", "--to", "made/pushes-v0")[2]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["own-v0", "pushes", "pushes-v0"]
