"""`python -m cavin_pyro.data` info, verify, merge and export, the last read back with Minari's own reader."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from cavin_pyro.config.commands import WindowConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.collection import collect
from cavin_pyro.data.dataset import (
    check_distinct,
    content_records,
    read_metadata,
    read_shard,
    shard_path,
    slots_of,
    write_metadata,
    write_shard,
)
from cavin_pyro.data.features import geometry_fingerprint, shard_features
from cavin_pyro.data.summary import summarize_data
from cavin_pyro.data.windows import load_windows
from cavin_pyro.models.networks.pointnet import PointNet


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory, small: SimpleNamespace) -> Path:
    """The world of `pushes` with another seed, policy and number of episodes per file, and up to 7 objects: 1 file."""
    folder = tmp_path_factory.mktemp("data") / "others"
    folder.mkdir()
    config = replace(small.pushes, seed=4, episodes_per_shard=3, perturbation_rate=0.1, maximum_objects=7)
    assert collect(replace(config, minimum_objects=6), folder, transitions=10, workers=1)["shards"] == 1
    return folder


@pytest.fixture
def merged(data: Callable, own_pushes: Path, others: Path, tmp_path: Path) -> Path:
    shard_features(own_pushes, 0, PointNet(), "0123456789ab")
    status, output, errors = data("merge", own_pushes, others, "--to", tmp_path / "both")
    both = [read_metadata(folder)["transitions"] for folder in (own_pushes, others)]
    assert (status, errors) == (0, "")
    assert output == f"{sum(both)} transitions in 15 episodes, in {tmp_path / 'both'}\n"
    return tmp_path / "both"


def test_info_tells_what_is_in_a_dataset(data: Callable, own_pushes: Path) -> None:
    metadata = read_metadata(own_pushes)
    shards = [read_shard(shard_path(own_pushes, number)) for number in range(3)]
    status, output, errors = data("info", own_pushes)
    assert (status, errors) == (0, "")
    there = np.concatenate([arrays["shape"][arrays["mask"]] for arrays in shards])
    of_each = ", ".join(f"{name} {(there == number).sum()}" for number, name in enumerate(metadata["shape_names"]))
    for told in (f"{metadata['transitions']} in 12 episodes", "3 of 3 readable", "3 (12 episodes)", of_each):
        assert told in output
    shard_path(own_pushes, 1).unlink()
    assert "2 of 3 readable" in data("info", own_pushes)[1]


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
        ({"visible": np.ones_like}, ["array visible: an object that mask denies is visible"]),
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
    for words in (["info", tmp_path], ["look", tmp_path], ["merge", tmp_path]):
        status, output, errors = data(*words)
        assert (status, output, errors.count("error:")) == (2, "", 1)
    assert not list(tmp_path.iterdir())


def test_a_merged_dataset_is_its_sources_one_after_another(
    merged: Path, own_pushes: Path, others: Path, data: Callable
) -> None:
    sources = [*(shard_path(own_pushes, n) for n in range(3)), shard_path(others, 0)]
    assert [shard_path(merged, n).read_bytes() for n in range(4)] == [path.read_bytes() for path in sources]
    assert [path.name for path in (merged / "features-0123456789ab").iterdir()] == ["episodes-00000.h5"]
    metadata = read_metadata(merged)
    assert (metadata["shards"], metadata["episodes"], slots_of(metadata)) == (4, 15, 7)
    assert [source["configuration"]["seed"] for source in metadata["sources"]] == [3, 4]
    assert not {"seed", "episodes_per_shard", "perturbation_rate"} & set(metadata["configuration"])
    assert data("verify", merged)[0] == 0
    assert "3 (12 episodes), 4 (3 episodes)" in data("info", merged)[1]
    assert len(summarize_data(merged).objects) == 8
    assert content_records(merged) == [*content_records(own_pushes), *content_records(others)]


def test_windows_are_those_of_the_datasets_together(merged: Path, own_pushes: Path, others: Path) -> None:
    """So that trainings are equal; with room for the most objects."""
    pointnet, config = PointNet().requires_grad_(False).eval(), WindowConfig(minimum_move=0.001)
    one, several = (load_windows(folders, pointnet, config) for folders in ([merged], [own_pushes, others]))
    for name in ("starts", "sequence_mask", "episodes", "training", "validation"):
        assert torch.equal(getattr(one, name), getattr(several, name)), name
    numbers = torch.arange(len(one.starts))
    ours, theirs = one.batch(numbers), several.batch(numbers)
    assert ours.states.objects == 7
    assert all(torch.equal(*pair) for pair in zip(ours.states, theirs.states, strict=True))


def test_a_merged_dataset_neither_grows_nor_counts_twice(
    merged: Path, own_pushes: Path, others: Path, data: Callable, small: SimpleNamespace, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="holds a merged dataset, which cannot grow"):
        collect(replace(small.pushes, seed=0), merged, transitions=1000, workers=1)
    assert "both have episodes of seed=4" in data("merge", merged, others, "--to", merged.parent / "twice")[2]
    with pytest.raises(UserError, match="names the same episodes twice"):
        check_distinct([others, merged])
    metadata = read_metadata(merged)
    for sources in ([{**metadata["sources"][0], "shards": 2}, metadata["sources"][1]], [metadata["sources"][0]] * 2):
        write_metadata(merged, {**metadata, "sources": sources})
        with pytest.raises(UserError, match="is damaged: its sources do not add up to the dataset"):
            read_metadata(merged)


def test_what_cannot_be_merged_is_refused_and_leaves_nothing(
    data: Callable, own_pushes: Path, others: Path, tmp_path: Path
) -> None:
    def refusal(*folders: Path, to: str = "result") -> str:
        before = sorted(tmp_path.rglob("*"))
        status, _, errors = data("merge", *folders, "--to", tmp_path / to)
        assert status == 2 and sorted(tmp_path.rglob("*")) == before
        return errors

    assert "at least two datasets" in refusal(own_pushes)
    assert "both have episodes of seed=3" in refusal(own_pushes, own_pushes)
    assert "holds a dataset already" in refusal(own_pushes, others, to="pushes")
    metadata = read_metadata(own_pushes)
    for name, value in (("camera", "kinect2"), ("steps", 7)):
        write_metadata(own_pushes, {**metadata, "configuration": {**metadata["configuration"], name: value}})
        assert f"are not of the same world ({name} is" in refusal(own_pushes, others)
    write_metadata(own_pushes, metadata)
    shard_path(own_pushes, 2).unlink()
    assert "episodes-00002.h5: " in refusal(own_pushes, others)


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
