"""`python -m cavin_pyro.data` verify and export, the last read back with Minari's own reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from cavin_pyro.data.dataset import (
    read_metadata,
    read_shard,
    shard_path,
    write_metadata,
    write_shard,
)
from cavin_pyro.data.features import geometry_fingerprint, shard_features
from cavin_pyro.models.networks.pointnet import PointNet


def test_a_whole_dataset_has_no_defect(data: Callable, own_pushes: Path) -> None:
    pointnet = PointNet()
    shard_features(own_pushes, 0, pointnet, geometry_fingerprint(pointnet))
    assert data("verify", own_pushes) == (0, f"{own_pushes}: 3 files with 12 episodes, no defect\n", "")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"actions": lambda one: one[1:]}, ["actions has shape [3, 6, 4], not [4, 6, 4]"]),
        (
            {"angle": lambda one: one * np.nan, "mass": lambda one: one - 200},
            ["array angle: angle has values outside of", "array mass: mass has values outside of 0 to 100"],
        ),
        ({"shape": lambda one: one + 90}, [" of 10 in metadata.json"]),
        ({"episode": lambda one: one - 4}, ["it repeats episode 0"]),
        ({"length": lambda one: one + 7}, ["pushes in an episode of 6", "metadata.json: counts"]),
    ],
)
def test_each_defect_is_a_line(changes: dict[str, Any], said: list[str], data: Callable, own_pushes: Path) -> None:
    path = shard_path(own_pushes, 1)
    arrays = read_shard(path)
    write_shard(path, arrays | {name: change(arrays[name]) for name, change in changes.items()})
    status, output, errors = data("verify", own_pushes)
    lines = sorted(output.splitlines())
    assert status == 2 and len(lines) == len(said)
    assert all(any(words in line for line in lines) for words in said), lines
    assert errors.startswith(f"error: {own_pushes} has {len(said)} defect")


def test_damaged_files_lost_ones_and_features_of_another_file_are_named_together(
    data: Callable, own_pushes: Path
) -> None:
    pointnet = PointNet()
    mark = geometry_fingerprint(pointnet)
    shard_features(own_pushes, 2, pointnet, mark)
    write_shard(
        shard_path(own_pushes, 2), {**(arrays := read_shard(shard_path(own_pushes, 2))), "angle": -arrays["angle"]}
    )
    content = bytearray(shard_path(own_pushes, 0).read_bytes())
    middle = len(content) // 2  # among the clouds, most of the file
    content[middle : middle + 8] = bytes(8)
    shard_path(own_pushes, 0).write_bytes(content)
    shard_path(own_pushes, 1).unlink()
    status, output, _ = data("verify", own_pushes)
    first, second, third = output.splitlines()
    assert status == 2
    assert first.startswith(f"{shard_path(own_pushes, 0)}: array clouds: ")
    assert second == f"{shard_path(own_pushes, 1)}: it is missing"
    assert third.startswith(f"{own_pushes / f'features-{mark}' / 'episodes-00002.h5'}: it is of other content than")


def test_a_wrong_command_line_is_one_line(data: Callable, tmp_path: Path) -> None:
    for words in (["verify", tmp_path], ["look", tmp_path], ["export", tmp_path]):
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
