from __future__ import annotations

import errno
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cavin_pyro.config.errors import UserError
from cavin_pyro.data.dataset import (
    CorruptShardError,
    iterate_shards,
    read_metadata,
    read_shard,
    shard_path,
    write_metadata,
    write_shard,
)


def spoil(path: Path, position: int) -> None:
    """Flip all bits of eight bytes."""
    content = bytearray(path.read_bytes())
    for place in range(position, min(position + 8, len(content))):
        content[place] ^= 0xFF
    path.write_bytes(content)


def test_a_shard_is_read_as_it_was_written(tmp_path: Path) -> None:
    arrays = {
        "half": np.random.default_rng(0).normal(size=(3, 70, 2)).astype(np.float16),
        "flags": np.array([True, False]),
        "number": np.array([7], np.int64),
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


@given(place=st.floats(0.0, 1.0))
def test_a_damaged_shard_is_named_or_is_read_as_it_was_written(
    pushes: Path, tmp_path_factory: pytest.TempPathFactory, place: float
) -> None:
    """Never other numbers than those that were written, and never another error."""
    good = shard_path(pushes, 0)
    path = tmp_path_factory.mktemp("damaged") / "episodes-00000.h5"
    path.write_bytes(good.read_bytes())
    spoil(path, int(place * (path.stat().st_size - 1)))
    whole = read_shard(good)
    try:
        arrays = read_shard(path)
    except UserError as error:
        assert f"shard {path} is missing or corrupt" in str(error)
        assert "\n" not in str(error)
    else:
        assert arrays.keys() == whole.keys()
        assert all(np.array_equal(arrays[name], whole[name]) for name in whole)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_a_truncated_shard_is_named(share: float, own_pushes: Path) -> None:
    path = shard_path(own_pushes, 1)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    said = r"episodes-00001\.h5 is missing or corrupt .*skip_corrupt=true"
    with pytest.raises(CorruptShardError, match=said) as found:
        read_shard(path)
    assert f": collect it again with python -m cavin_pyro.collect output={own_pushes} repair=true and" in str(
        found.value
    )
    in_another_process = pickle.loads(pickle.dumps(found.value))
    assert (str(in_another_process), in_another_process.defect) == (str(found.value), found.value.defect)
    with pytest.raises(UserError, match="merge the datasets again"):  # collect repairs no merged dataset
        read_shard(path, metadata={"sources": []})


def test_a_shard_that_lacks_an_array_is_named(tmp_path: Path) -> None:
    write_shard(tmp_path / "a.h5", {"centers": np.zeros((2, 4, 5, 3), np.float32)})
    with pytest.raises(UserError, match=r"a\.h5 is missing or corrupt \(.*clouds"):
        read_shard(tmp_path / "a.h5", ("centers", "clouds"))


def test_a_full_disk_leaves_no_half_shard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, content: bytes) -> int:
        with open(path, "wb") as file:
            file.write(content[:100])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(OSError, match="No space left"):
        write_shard(tmp_path / "a.h5", {"centers": np.zeros(300)})
    assert not list(tmp_path.iterdir())


def test_shards_come_in_order(pushes: Path) -> None:
    shards = list(iterate_shards(pushes, ("episode", "length")))
    assert [number for number, _ in shards] == [0, 1, 2]
    assert np.concatenate([arrays["episode"] for _, arrays in shards]).tolist() == list(range(12))
    metadata = read_metadata(pushes)
    assert metadata["episodes"] == 12
    assert metadata["transitions"] == sum(arrays["length"].sum() for _, arrays in shards)


def test_corrupt_shards_are_skipped_and_named(own_pushes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = shard_path(own_pushes, 1)
    spoil(path, path.stat().st_size // 2)
    with pytest.raises(UserError, match=r"episodes-00001\.h5 is missing or corrupt"):
        list(iterate_shards(own_pushes, ("clouds", "episode")))
    kept = list(iterate_shards(own_pushes, ("clouds", "episode"), skip_corrupt=True))
    assert [number for number, _ in kept] == [0, 2]
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"left out: shard {path}")
    assert line.endswith(")")  # no advice about what is being done


def test_a_dataset_without_any_whole_shard_is_refused(own_pushes: Path) -> None:
    for number in range(3):
        shard_path(own_pushes, number).unlink()
    with pytest.raises(UserError, match="has no usable shard: collect it again"):
        list(iterate_shards(own_pushes, ("episode",), skip_corrupt=True))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"format": "photographs"}, "does not describe a dataset of this program"),
        ({"version": 2}, "has format version 2, this program reads 1: collect it again"),
        ({"shards": 0}, "is empty: collect it again"),
        ({"shards": "three"}, "is damaged"),
        ({"transitions": None}, "is damaged"),
        ({"configuration": 5}, "is damaged"),
    ],
)
def test_metadata_of_something_else_are_refused(changes: dict, said: str, own_pushes: Path) -> None:
    write_metadata(own_pushes, {**read_metadata(own_pushes), **changes})
    with pytest.raises(UserError, match=said):
        read_metadata(own_pushes)


def test_a_folder_without_a_dataset_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"make one with python -m cavin_pyro.collect .* output="):
        read_metadata(tmp_path)
