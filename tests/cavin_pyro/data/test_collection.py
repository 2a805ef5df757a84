from __future__ import annotations

import errno
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cavin_pyro.config.errors import UserError
from cavin_pyro.data.collection import collect, collect_episode
from cavin_pyro.data.dataset import read_metadata, read_shard, shard_path, write_metadata
from cavin_pyro.envs.tabletop.objects.sampling import ObjectRanges
from cavin_pyro.envs.tabletop.objects.shapes import BUILTIN_NAMES
from cavin_pyro.envs.tabletop.scene import Scene


def data_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_a_dataset_grows_without_changing_what_it_held(small: SimpleNamespace, pushes: Path, tmp_path: Path) -> None:
    for transitions in (1, 20, 30, 60, 60):
        metadata = collect(small.pushes, tmp_path, transitions=transitions, workers=1)
        assert metadata["transitions"] >= transitions
    assert data_of(tmp_path) == data_of(pushes)


def test_an_episode_depends_on_the_seed_and_its_number_alone(small: SimpleNamespace, pushes: Path) -> None:
    """So that the data depend neither on the number of workers nor on where an interrupted run resumed."""
    scene = Scene()
    again = collect_episode(scene, small.pushes, 6)
    other = collect_episode(scene, replace(small.pushes, seed=4), 6)
    scene.close()
    kept = read_shard(shard_path(pushes, 1))  # episodes 4 to 7
    assert again.keys() == kept.keys()
    for name, array in again.items():
        np.testing.assert_array_equal(kept[name][2], array, err_msg=name)
    assert not np.array_equal(other["actions"], again["actions"])


def test_episodes_hold_what_the_metadata_say(pushes: Path) -> None:
    metadata = read_metadata(pushes)
    assert metadata["configuration"]["seed"] == 3
    assert metadata["shape_names"] == list(BUILTIN_NAMES)
    for number in range(metadata["shards"]):
        arrays = read_shard(shard_path(pushes, number))
        assert arrays["clouds"].shape == (4, 7, 5, 256, 3)
        assert arrays["episode"].tolist() == list(range(4 * number, 4 * number + 4))
        real = arrays["mask"]
        assert ((arrays["shape"] >= 0) == real).all()
        # A push that moved nothing is ineffective, and where objects moved, their centres were seen elsewhere.
        assert (arrays["moved"][arrays["ineffective"]] < 0.005).all()
        far = (arrays["moved"] > 0.05) & arrays["visible"][:, :-1] & arrays["visible"][:, 1:]
        seen = np.linalg.norm(np.diff(arrays["centers"], axis=1), axis=-1)
        assert (seen[far] > 0.02).all()
        assert (arrays["length"][~arrays["fallen"].any(axis=1)] == 6).all()


def test_another_configuration_is_refused_and_changes_nothing(small: SimpleNamespace, own_pushes: Path) -> None:
    before = data_of(own_pushes)
    for changes in ({"seed": 4}, {"ranges": replace(small.pushes.ranges, mass=(1.0, 1.0))}):
        with pytest.raises(UserError, match=f"holds a dataset with {next(iter(changes))}="):
            collect(replace(small.pushes, **changes), own_pushes, transitions=100, workers=1)
    write_metadata(own_pushes, {**read_metadata(own_pushes), "version": 2})
    with pytest.raises(UserError, match="has format version 2"):
        collect(small.pushes, own_pushes, transitions=1, workers=1)
    assert {name for name, content in data_of(own_pushes).items() if content != before[name]} == {"metadata.json"}


def test_scans_and_builtin_shapes_are_collected_together(
    small: SimpleNamespace, tiny_assets: Path, tmp_path: Path
) -> None:
    kinds = {"object_set": "mixed", "ranges": ObjectRanges(("mug", "brick"), clearance=0.12)}
    config = replace(small.pushes, **kinds, assets=str(tiny_assets), episodes_per_shard=10, steps=1)
    metadata = collect(config, tmp_path, transitions=10, workers=1)
    assert metadata["shape_names"] == [*BUILTIN_NAMES, "ycb/brick", "ycb/mug", "ycb/angle"]
    assert "assets" not in metadata["configuration"]
    shapes = read_shard(shard_path(tmp_path, 0))["shape"]
    assert {metadata["shape_names"][shape] for shape in shapes[shapes >= 0]} == {"mug", "ycb/mug", "ycb/brick"}


def test_missing_and_damaged_files_are_collected_again(
    small: SimpleNamespace, own_pushes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = data_of(own_pushes)
    shard_path(own_pushes, 0).unlink()
    content = shard_path(own_pushes, 2).read_bytes()
    shard_path(own_pushes, 2).write_bytes(content[: len(content) // 2])
    for again in (2, 0):
        collect(small.pushes, own_pushes, transitions=60, workers=1)
        assert data_of(own_pushes) == before
        assert capsys.readouterr().out.count("collecting again: ") == again


def test_a_full_disk_leaves_whole_files_that_count_and_room_to_go_on(
    small: SimpleNamespace, pushes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    move = os.replace

    def refuse(source: Path, target: Path) -> None:
        if str(target).endswith("00001.h5"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        move(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refuse)
        with pytest.raises(OSError, match="No space left on device") as caught:
            collect(small.pushes, tmp_path, transitions=60, workers=1)
    assert caught.value.filename == str(shard_path(tmp_path, 1))
    assert data_of(tmp_path).keys() == {"metadata.json", "episodes-00000.h5"}
    assert read_metadata(tmp_path)["shards"] == 1
    collect(small.pushes, tmp_path, transitions=60, workers=1)
    assert data_of(tmp_path) == data_of(pushes)
