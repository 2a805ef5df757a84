"""`python -m cavin_pyro.data info` and `verify`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cavin_pyro.data.dataset import read_metadata, read_shard, shard_path, write_metadata, write_shard
from cavin_pyro.data.features import geometry_fingerprint, shard_features
from models.networks.pointnet import PointNet

Arrays = dict[str, Any]


def test_info_tells_what_is_in_a_dataset(data: Callable, pushes: Path, own_pushes: Path) -> None:
    status, output, errors = data("info", own_pushes)
    metadata = read_metadata(pushes)
    shards = [read_shard(shard_path(pushes, number)) for number in range(3)]
    per_episode = np.bincount(np.concatenate([arrays["mask"].sum(-1) for arrays in shards]))
    assert (status, errors) == (0, "")
    rows = {line[:14].strip(): line[14:] for line in output.splitlines()}
    full = metadata["transitions"] / 72
    assert rows["pushes"] == f"{metadata['transitions']} in 12 episodes of at most 6: {full:.1%} full"
    assert rows["files"].startswith("3 of 3 readable, ") and "features of 0 geometries" in rows["files"]
    assert rows["seeds"] == "3 (12 episodes)"
    counts = ", ".join(f"{n}: {count}" for n, count in enumerate(per_episode) if count)
    assert rows["on the table"] == f"{counts} (objects: episodes)"
    there = np.concatenate([arrays["shape"][arrays["mask"]] for arrays in shards])
    assert rows["objects"] == ", ".join(f"{n} {(there == i).sum()}" for i, n in enumerate(metadata["shape_names"]))
    assert rows["world"] == "object_set builtin, camera ideal, segmentation mask"
    assert "perturbation_rate=0.3" in rows["policy"] and "clearance=" in rows["ranges"]


def test_info_counts_files_that_cannot_be_read(data: Callable, own_pushes: Path) -> None:
    shard_path(own_pushes, 1).unlink()
    assert "2 of 3 readable" in data("info", own_pushes)[1]


def test_a_whole_dataset_has_no_defect(data: Callable, own_pushes: Path) -> None:
    pointnet = PointNet()
    for number in range(3):
        shard_features(own_pushes, number, pointnet, geometry_fingerprint(pointnet))
    status, output, errors = data("verify", own_pushes)
    assert (status, output, errors) == (0, f"{own_pushes}: 3 files with 12 episodes, no defect\n", "")


def spoil(path: Path, change: Callable[[Arrays], None]) -> None:
    arrays = read_shard(path)
    change(arrays)
    write_shard(path, arrays)


def put(name: str, value: Any) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[name].flat[0] = value

    return change


def both(*changes: Callable[[Arrays], None]) -> Callable[[Arrays], None]:
    return lambda arrays: [change(arrays) for change in changes] and None


def one_row_fewer(arrays: Arrays) -> None:
    arrays["actions"] = arrays["actions"][1:]


def single_precision(arrays: Arrays) -> None:
    arrays["clouds"] = arrays["clouds"].astype(np.float32)


SPOILT: dict[str, tuple[Callable[[Arrays], None], list[str]]] = {
    "shape": (one_row_fewer, ["actions has shape [3, 6, 4], not [4, 6, 4]"]),
    "dtype": (single_precision, ["clouds has type float32, not float16"]),
    "two arrays": (
        both(put("angle", np.nan), put("mass", -1.0)),
        ["array mass: mass has values outside of 0 to 100", "array angle: angle has values outside of"],
    ),
    "missing": (lambda arrays: arrays.pop("target"), ["array target: "]),
    "object": (put("shape", 99), ["array shape: object 99 of 10 in metadata.json"]),
    "repeated": (put("episode", 0), ["repeats episode 0"]),
    "too long": (put("length", 7), ["array length: 7 pushes in an episode of 6", "metadata.json: counts"]),
}


@pytest.mark.parametrize("name", SPOILT)
def test_each_defect_is_a_line(name: str, data: Callable, own_pushes: Path) -> None:
    change, said = SPOILT[name]
    path = shard_path(own_pushes, 1)
    spoil(path, change)
    status, output, errors = data("verify", own_pushes)
    lines = output.splitlines()
    assert status == 2
    assert len(lines) == len(said)
    for words in said:
        assert [line for line in lines if words in line and (path.name in line or "metadata.json" in line)], lines
    assert errors.startswith(f"error: {own_pushes} has {len(said)} defect")


def test_flipped_bytes_lost_files_and_wrong_counts_are_named_together(data: Callable, own_pushes: Path) -> None:
    pointnet = PointNet()
    mark = geometry_fingerprint(pointnet)
    shard_features(own_pushes, 2, pointnet, mark)
    features = own_pushes / f"features-{mark}" / shard_path(own_pushes, 2).name
    features.write_bytes(features.read_bytes()[:-100])
    content = bytearray(shard_path(own_pushes, 0).read_bytes())
    middle = len(content) // 2  # among the clouds, most of the file
    content[middle : middle + 8] = bytes(8)
    shard_path(own_pushes, 0).write_bytes(content)
    shard_path(own_pushes, 1).unlink()
    status, output, _ = data("verify", own_pushes)
    files = [line.split(": ")[0] for line in output.splitlines()]
    assert status == 2
    assert files == [str(shard_path(own_pushes, 0)), str(shard_path(own_pushes, 1)), str(features)]
    assert "array clouds" in output and "00001.h5: it is missing" in output


def test_features_of_another_file_are_named(data: Callable, own_pushes: Path) -> None:
    pointnet = PointNet()
    mark = geometry_fingerprint(pointnet)
    shard_features(own_pushes, 1, pointnet, mark)
    features = own_pushes / f"features-{mark}" / shard_path(own_pushes, 1).name
    spoil(shard_path(own_pushes, 1), put("angle", 0.5))
    status, output, _ = data("verify", own_pushes)
    assert (status, output) == (2, f"{features}: it is of other content than {shard_path(own_pushes, 1)}\n")


def test_a_repeated_episode_is_told_whatever_the_folder_is_called(
    data: Callable, own_pushes: Path, tmp_path: Path
) -> None:
    folder = own_pushes.rename(tmp_path / "old: pushes")
    spoil(shard_path(folder, 1), put("episode", 0))
    status, output, _ = data("verify", folder)
    assert (status, output) == (2, f"{shard_path(folder, 1)}: it repeats episode 0\n")


def test_metadata_that_count_other_pushes_are_named(data: Callable, own_pushes: Path) -> None:
    metadata = read_metadata(own_pushes)
    write_metadata(own_pushes, {**metadata, "transitions": metadata["transitions"] - 1})
    status, output, _ = data("verify", own_pushes)
    held = metadata["transitions"]
    assert (status, len(output.splitlines())) == (2, 1)
    assert output.endswith(f"metadata.json: counts {held - 1} transitions, the files have {held}\n")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("info nowhere", "no dataset in nowhere: make one with"),
        ("verify nowhere", "no dataset in nowhere: make one with"),
        ("look nowhere", "invalid choice: 'look' (choose from"),
        ("", "the following arguments are required: info|verify|merge|export"),
        ("info", "the following arguments are required: DIR"),
        ("merge nowhere", "the following arguments are required: --to"),
        ("export a b --to c-v0", "unrecognized arguments: b"),
    ],
)
def test_a_wrong_command_line_is_one_line(
    words: str, said: str, data: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    status, output, errors = data(*words.split())
    assert (status, output) == (2, "")
    assert said in errors and errors.count("\n") == 0
    assert not list(tmp_path.iterdir())


def test_the_command_starts_with_an_interpreter_of_its_own(
    shell: SimpleNamespace, own_pushes: Path, tmp_path: Path
) -> None:
    (own_pushes / "metadata.json").write_text(json.dumps({"format": "another"}))
    answer = shell.run_as_users("data", "info", "pushes", folder=tmp_path)
    assert (answer.status, answer.output) == (2, "")
    assert answer.complaints == ["error: pushes/metadata.json does not describe a dataset of this program"]
