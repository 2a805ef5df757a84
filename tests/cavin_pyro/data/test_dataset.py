"""Shards and metadata: read as written; damaged, cut or made on purpose, they are named and never used."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavin_pyro.config.errors import UserError
from cavin_pyro.data.dataset import (
    ARRAYS,
    Arrays,
    iterate_shards,
    padded,
    read_metadata,
    read_shard,
    shard_path,
    slots_of,
    write_metadata,
    write_shard,
)


def test_a_shard_is_read_as_it_was_written(tmp_path: Path) -> None:
    arrays = {
        "half": np.random.default_rng(0).normal(size=(3, 70, 2)).astype(np.float16),
        "flags": np.array([True, False]),
        "none": np.zeros((0, 3), np.float32),
    }
    write_shard(tmp_path / "a.h5", arrays)
    back = read_shard(tmp_path / "a.h5")
    assert back.keys() == arrays.keys()
    for name, array in arrays.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)
    assert read_shard(tmp_path / "a.h5", ("flags",)).keys() == {"flags"}
    write_shard(tmp_path / "b.h5", dict(reversed(arrays.items())))
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


@settings(max_examples=30)
@given(place=st.floats(0.0, 1.0))
def test_a_damaged_shard_is_named_or_is_read_as_it_was_written(
    pushes: Path, tmp_path_factory: pytest.TempPathFactory, place: float
) -> None:
    """Never other numbers than those that were written, and never another error."""
    good = shard_path(pushes, 0)
    path = tmp_path_factory.mktemp("damaged") / "episodes-00000.h5"
    content = bytearray(good.read_bytes())
    start = int(place * (len(content) - 1))
    content[start : start + 8] = bytes(byte ^ 0xFF for byte in content[start : start + 8])
    path.write_bytes(content)
    whole = read_shard(good)
    try:
        arrays = read_shard(path)
    except UserError as error:
        assert f"shard {path} is missing or corrupt" in str(error) and "\n" not in str(error)
    else:
        assert arrays.keys() == whole.keys()
        assert all(np.array_equal(arrays[name], whole[name]) for name in whole)


def linked(path: Path, arrays: Arrays) -> None:
    write_shard(path.with_name("other.h5"), arrays)
    with h5py.File(path, "a") as file:
        del file["actions"]
        file["actions"] = h5py.ExternalLink("other.h5", "/actions")


def bomb(path: Path, arrays: Arrays) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("centers", (10**9, 11, 5, 3), np.float32, chunks=(10**4, 11, 5, 3), compression="gzip")


def changed(name: str, change: Callable[[Any], Any]) -> Callable[[Path, Arrays], None]:
    return lambda path, arrays: write_shard(path, {**arrays, name: change(arrays[name])})


SPOILT: dict[str, tuple[Callable[[Path, Arrays], Any], str]] = {
    "missing": (lambda path, arrays: path.unlink(), "it is missing"),
    "an array less": (lambda path, arrays: write_shard(path, {"mask": arrays["mask"]}), "object"),
    "fewer": (changed("actions", lambda one: one[1:]), r"actions has shape \[3, 6, 4\], not \[4, 6, 4\]"),
    "another type": (changed("actions", lambda one: one.astype(float)), "actions has type float64, not float32"),
    "not finite": (changed("actions", lambda one: one * np.nan), "actions has values outside of -1 to 1: nan to nan"),
    "longer": (changed("length", lambda one: one + 7), "array length: 13 pushes in an episode of 6"),
    "an object too many": (changed("target", lambda one: one + 5), r"array target: object \d of 5"),
    "an object of no shape": (changed("shape", lambda one: one * 0 - 1), "array shape: -1 of an object that is there"),
    "an object of no size": (changed("scale", lambda one: one * 0), "array scale: 0.0 of an object that is there"),
    "elsewhere": (linked, "actions is no array in this file"),
    "unpacks to 660 gigabytes": (bomb, r"centers has shape \[1000000000, 11, 5, 3\]"),
}


@pytest.mark.parametrize("kind", SPOILT)
def test_a_shard_that_does_not_fit_is_named(kind: str, own_pushes: Path) -> None:
    change, said = SPOILT[kind]
    path = shard_path(own_pushes, 1)
    change(path, read_shard(path))
    names = ("actions", "length", "mask", "target", "shape", "scale")
    with pytest.raises(UserError, match=rf"^shard .*episodes-00001\.h5 is missing or corrupt \(.*({said})") as refused:
        list(iterate_shards(own_pushes, names))
    assert "\n" not in str(refused.value) and "cavin_pyro.collect again" in str(refused.value)


def test_shards_come_in_order_and_none_repeats_an_episode(own_pushes: Path) -> None:
    shards = list(iterate_shards(own_pushes, ("length",)))
    assert [number for number, _ in shards] == [0, 1, 2]
    assert np.concatenate([arrays["episode"] for _, arrays in shards]).tolist() == list(range(12))
    assert read_metadata(own_pushes)["transitions"] == sum(arrays["length"].sum() for _, arrays in shards)
    shard_path(own_pushes, 2).write_bytes(shard_path(own_pushes, 0).read_bytes())
    with pytest.raises(UserError, match=r"episodes-00002\.h5 repeats episode 0"):
        list(iterate_shards(own_pushes, ("length",)))
    path = shard_path(own_pushes, 0)
    changed("episode", lambda one: one * 0 + 9)(path, read_shard(path))
    with pytest.raises(UserError, match=r"episodes-00000\.h5 repeats episode 9"):
        list(iterate_shards(own_pushes, ("length",)))


def test_padding_adds_slots_without_objects(pushes: Path) -> None:
    arrays = read_shard(shard_path(pushes, 0))
    assert set(arrays) == set(ARRAYS)
    wider = padded(arrays, 8)
    assert (wider["shape"][:, 5:] == -1).all() and not wider["mask"][:, 5:].any()
    for name, array in arrays.items():
        np.testing.assert_array_equal(wider[name][tuple(map(slice, array.shape))], array, err_msg=name)
    with pytest.raises(UserError, match="room for more than the 4 objects"):
        padded(arrays, 4)
    assert slots_of(read_metadata(pushes)) == 5


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"format": "photographs"}, "does not describe a dataset of this program"),
        ({"version": 2}, "has format version 2, this program reads 1: collect it again"),
        ({"shards": 0}, "is damaged, .*: shards must be a whole number of at least 1, not 0$"),
        ({"configuration": {"steps": 6, "maximum_objects": 11}}, "of at least 1 and at most 10, not 11$"),
        ({"shards": 10**9}, "files have not 12 episodes"),
        ({"shards": 10**9, "episodes": 4 * 10**9}, "counts 1000000000 files of episodes, but 3 are there"),
    ],
)
def test_metadata_that_cannot_be_are_refused_at_once(changes: dict, said: str, own_pushes: Path) -> None:
    write_metadata(own_pushes, {**read_metadata(own_pushes), **changes})
    with pytest.raises(UserError, match=said):
        list(iterate_shards(own_pushes, ("episode",)))
