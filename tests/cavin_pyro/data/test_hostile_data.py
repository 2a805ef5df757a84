"""Data that were damaged, cut or made on purpose: whatever does not fit its declaration is named, never used."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.collection import repair
from cavin_pyro.data.dataset import iterate_shards, read_metadata, read_shard, shard_path, write_metadata, write_shard
from cavin_pyro.data.declaration import ARRAYS, BESIDE
from cavin_pyro.data.features import geometry_fingerprint, sample_clouds, shard_features
from cavin_pyro.data.maintenance.info import describe
from cavin_pyro.data.maintenance.verify import find_defects
from cavin_pyro.data.windows import load_windows
from models.networks.pointnet import PointNet

Arrays = dict[str, Any]


def set_first(name: str, value: float) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[name].flat[0] = value

    return change


def replaced(name: str, function: Callable[[Any], Any]) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[name] = function(arrays[name])

    return change


SPOILT: dict[str, tuple[Callable[[Arrays], None], str]] = {
    "an episode fewer": (replaced("actions", lambda one: one[1:]), r"actions has shape \[3, 6, 4\], not \[4, 6, 4\]"),
    "a push fewer": (replaced("actions", lambda one: one[:, 1:]), r"actions has shape \[4, 5, 4\], not \[4, 6, 4\]"),
    "an object fewer": (replaced("mask", lambda one: one[:, 1:]), r"mask has shape \[4, 4\], not \[4, 5\]"),
    "flat": (replaced("centers", np.ravel), r"centers has shape \[420\], not \[4, 7, 5, 3\]"),
    "another type": (replaced("actions", lambda one: one.astype(np.float64)), "actions has type float64, not float32"),
    "numbers for flags": (replaced("mask", lambda one: one.astype(np.int64)), "mask has type int64, not bool"),
    "text": (replaced("actions", lambda one: one.astype("S8")), r"actions has type \|S8, not float32"),
    "NaN": (set_first("centers", np.nan), "centers has values outside of -100 to 100: nan to nan"),
    "infinity": (set_first("clouds", -np.inf), "clouds has values outside of"),
    "out of range": (set_first("actions", 1.5), "actions has values outside of -1 to 1"),
    "a negative length": (set_first("length", -1), "length has values outside of"),
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_shard_that_does_not_fit_its_declaration_is_named(name: str, own_pushes: Path) -> None:
    change, said = SPOILT[name]
    arrays = read_shard(shard_path(own_pushes, 1))
    change(arrays)
    write_shard(shard_path(own_pushes, 1), arrays)
    with pytest.raises(UserError, match=rf"episodes-00001\.h5 is missing or corrupt \({said}") as refused:
        load_windows([own_pushes], PointNet())
    assert "\n" not in str(refused.value)
    kept = iterate_shards(own_pushes, ("actions", "centers", "clouds", "length", "mask"), skip_corrupt=True)
    assert [number for number, _ in kept] == [0, 2]


def test_an_array_that_nobody_reads_tells_of_a_shard_of_another_size(own_pushes: Path) -> None:
    arrays = read_shard(shard_path(own_pushes, 0))
    write_shard(shard_path(own_pushes, 0), {name: array[1:] for name, array in arrays.items()})
    for read in (
        lambda: sample_clouds([own_pushes], count=5, generator=np.random.default_rng(0)),
        lambda: shard_features(own_pushes, 0, PointNet(), "0"),
    ):
        with pytest.raises(UserError, match=r"has shape \[3, .*\], not \[4, "):
            read()


def test_what_is_collected_is_what_is_declared(pushes: Path) -> None:
    assert {*read_shard(shard_path(pushes, 0)), *BESIDE} == set(ARRAYS)


def test_features_of_another_shape_are_made_again(own_pushes: Path) -> None:
    pointnet = PointNet()
    fingerprint = geometry_fingerprint(pointnet)
    good = shard_features(own_pushes, 0, pointnet, fingerprint)
    for bad in (good[1:], good.astype(np.float64), np.full_like(good, np.nan)):
        write_shard(own_pushes / f"features-{fingerprint}" / "episodes-00000.h5", {"features": bad})
        np.testing.assert_array_equal(shard_features(own_pushes, 0, pointnet, fingerprint), good)


def test_a_shard_with_damaged_clouds_is_left_out_as_others_are(
    own_pushes: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = WindowConfig(minimum_move=0.001, validation_fraction=0.4)
    whole = load_windows([own_pushes], PointNet(), config)
    for number in range(3):
        path = shard_path(own_pushes, number)
        content = bytearray(path.read_bytes())
        content[len(content) // 2 : len(content) // 2 + 8] = bytes(8)  # among the clouds, most of the file
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"episodes-0000[0-2]\.h5 is missing or corrupt"):
            load_windows([own_pushes], PointNet(), config)
        if number == 0:
            kept = load_windows([own_pushes], PointNet(), config, skip_corrupt=True)
            assert 0 < len(kept.starts) < len(whole.starts)
            assert f"left out: shard {path}" in capsys.readouterr().out
    with pytest.raises(UserError, match="has no usable shard: collect it again"):
        load_windows([own_pushes], PointNet(), config, skip_corrupt=True)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"shape_names": 5}, "shape_names must be a list of names"),
        ({"shape_names": [["mug"]]}, "shape_names must be a list of names"),
        ({"configuration": {"steps": 6, "ranges": [1]}}, "ranges must be a table"),
    ],
)
def test_metadata_of_another_form_are_refused(changes: dict, said: str, own_pushes: Path, small: Any) -> None:
    write_metadata(own_pushes, {**read_metadata(own_pushes), **changes})
    for use in (read_metadata, partial(repair, small.pushes), describe, lambda folder: [*find_defects(folder)]):
        with pytest.raises(UserError, match=rf"metadata\.json is damaged: {said}"):
            use(own_pushes)


@pytest.mark.parametrize("name", ["a" * 300, f"{'a' * 300}/b"])
def test_a_name_that_no_folder_can_have_is_one_line(name: str) -> None:
    with pytest.raises(UserError, match="dataset a+(/b)? cannot be read: File name too long"):
        read_metadata(Path(name))


def test_the_same_data_given_twice_are_refused(own_pushes: Path, pushes: Path) -> None:
    for folders in ([pushes, pushes], [pushes, own_pushes], [pushes, pushes.parent / "." / pushes.name]):
        with pytest.raises(UserError, match="data names the same episodes twice, .* name them once"):
            load_windows(folders, PointNet())
        with pytest.raises(UserError, match="data names the same episodes twice"):
            sample_clouds(folders, count=5, generator=np.random.default_rng(0))


def test_a_shard_in_place_of_another_is_refused(own_pushes: Path) -> None:
    shard_path(own_pushes, 2).write_bytes(shard_path(own_pushes, 0).read_bytes())
    with pytest.raises(UserError, match=r"episodes-00002\.h5 repeats episode 0"):
        load_windows([own_pushes], PointNet())


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"shards": 10**9}, "files have not 12 episodes"),
        ({"shards": 10**9, "episodes": 4 * 10**9}, "counts 1000000000 files of episodes, but 3 are there"),
        ({"transitions": 10**9}, "3 files have not 12 episodes with 1000000000 pushes"),
        ({"transitions": -1}, "with -1 pushes"),
        ({"configuration": {"steps": "6"}}, "steps and episodes_per_shard must be whole numbers"),
        ({"configuration": {"episodes_per_shard": 4}}, "steps and episodes_per_shard must be whole numbers"),
    ],
)
def test_counts_that_cannot_be_are_refused_at_once(changes: dict, said: str, own_pushes: Path) -> None:
    write_metadata(own_pushes, {**read_metadata(own_pushes), **changes})
    with pytest.raises(UserError, match=said):
        list(iterate_shards(own_pushes, ("episode",), skip_corrupt=True))


def external(file: h5py.File, path: Path) -> None:
    secret = path.with_name("secret")
    secret.write_bytes(bytes(4 * 6 * 4 * 4))
    file.create_dataset("actions", (4, 6, 4), np.float32, external=[(str(secret), 0, 4 * 6 * 4 * 4)])


def linked(file: h5py.File, path: Path) -> None:
    with h5py.File(path.with_name("other.h5"), "w") as other:
        other["actions"] = np.zeros((4, 6, 4), np.float32)
    file["actions"] = h5py.ExternalLink("other.h5", "/actions")


def virtual(file: h5py.File, path: Path) -> None:
    layout = h5py.VirtualLayout((4, 6, 4), np.float32)
    layout[:] = h5py.VirtualSource(str(path.with_name("other.h5")), "actions", (4, 6, 4))
    file.create_virtual_dataset("actions", layout)


def a_group(file: h5py.File, path: Path) -> None:
    file.create_group("actions")


@pytest.mark.parametrize("make", [external, linked, virtual, a_group])
def test_arrays_that_lie_in_other_files_are_not_read(make: Callable[[h5py.File, Path], None], own_pushes: Path) -> None:
    path = shard_path(own_pushes, 0)
    with h5py.File(path, "a") as file:
        del file["actions"]
        make(file, path)
    with pytest.raises(UserError, match="actions is no array in this file"):
        read_shard(path, ("actions",))


def test_a_small_file_that_unpacks_to_more_than_memory_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "bomb.h5", "w") as file:
        file.create_dataset("centers", (10**9, 11, 5, 3), np.float32, chunks=(10**4, 11, 5, 3), compression="gzip")
    with pytest.raises(UserError, match=r"centers has shape \[1000000000, 11, 5, 3\]"):
        read_shard(tmp_path / "bomb.h5")


def test_repair_collects_what_does_not_fit_again(own_pushes: Path, small: Any) -> None:
    good = shard_path(own_pushes, 1).read_bytes()
    arrays = read_shard(shard_path(own_pushes, 1))
    write_shard(shard_path(own_pushes, 1), {**arrays, "actions": arrays["actions"][1:]})
    assert repair(small.pushes, own_pushes) == 1
    assert shard_path(own_pushes, 1).read_bytes() == good
