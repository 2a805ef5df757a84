"""Verification: every array of every file of a dataset, against its declaration, its checksums and the metadata."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py

from cavin_pyro.config.errors import UserError
from cavin_pyro.data.dataset import Arrays, EpisodeNumbers, read_metadata, shard_digest, shard_path
from cavin_pyro.data.declaration import ARRAYS, BESIDE, check_file, check_values
from cavin_pyro.storage.progress import progress_bar

REQUIRED = tuple(name for name in ARRAYS if name not in BESIDE)  # of a shard
_UNREADABLE = (OSError, KeyError, RuntimeError, ValueError, TypeError, MemoryError)  # what h5py raises


def verify(folder: Path) -> None:
    """Print each defect of a dataset in a line, or that there is none.

    Raises:
        UserError: no dataset, or it has defects.
    """
    count = 0
    for defect in find_defects(folder):
        print(defect, flush=True)
        count += 1
    if count:
        raise UserError(
            f"{folder} has {count} defect{'s' if count > 1 else ''}: python -m cavin_pyro.collect repair=true, with "
            "the options of the collection, collects damaged files again; train makes damaged features again"
        )
    metadata = read_metadata(folder)
    print(f"{folder}: {metadata['shards']} files with {metadata['episodes']} episodes, no defect")


def find_defects(folder: Path) -> Iterator[str]:
    """The defects of a dataset, one line each; every array of every counted file is read.

    Raises:
        UserError: no dataset, or metadata that cannot be used.
    """
    metadata = read_metadata(folder)
    known, pushes = EpisodeNumbers(folder), 0
    beside = [one for one in sorted(folder.glob("features-*")) if one.is_dir()]
    with progress_bar("verifying", total=metadata["shards"], unit="file") as bar:
        for number in range(metadata["shards"]):
            path, arrays = shard_path(folder, number), Arrays()
            found = [*_damage(path, REQUIRED, metadata, arrays), *_disagreements(arrays, number, known, metadata)]
            yield from (f"{path}: {defect}" for defect in found)
            for features in (one / path.name for one in beside):
                if features.exists():
                    stored = Arrays()
                    yield from (f"{features}: {defect}" for defect in _damage(features, BESIDE, metadata, stored))
                    if not found and "shard_digest" in stored and _digest(stored) != shard_digest(path):
                        yield f"{features}: it is of other content than {path}"
            pushes = pushes + int(arrays["length"].sum()) if "length" in arrays else -(10**15)
            bar.update()
    if pushes >= 0 and pushes != metadata["transitions"]:
        yield f"{folder / 'metadata.json'}: counts {metadata['transitions']} transitions, the files have {pushes}"


def _damage(path: Path, names: tuple[str, ...], metadata: Mapping[str, Any], arrays: Arrays) -> Iterator[str]:
    """What is wrong with a file by itself; what can be read of it goes into `arrays`."""
    configuration = metadata["configuration"]
    if not path.exists():
        yield "it is missing"
        return
    try:
        with h5py.File(path, "r") as file:
            check_file(file, configuration)
            for name in names:
                if name == "shard_digest" and name not in file:
                    continue  # features of an older version
                try:
                    array = file[name][()]
                    check_values({name: array})
                    arrays[name] = array
                except _UNREADABLE as error:
                    yield f"array {name}: {_line(error)}"
    except _UNREADABLE as error:
        yield _line(error)


def _disagreements(arrays: Arrays, number: int, known: EpisodeNumbers, metadata: Mapping[str, Any]) -> Iterator[str]:
    """Contradictions between readable arrays of a shard, other shards and the metadata."""
    if "episode" in arrays and (repetition := known.repetition(number, arrays["episode"])):
        yield f"it {repetition}"
    if {"length", "actions"} <= set(arrays) and (arrays["length"] > arrays["actions"].shape[1]).any():
        yield f"array length: {arrays['length'].max()} pushes in an episode of {arrays['actions'].shape[1]}"
    if "shape" in arrays and "shape_names" in metadata and arrays["shape"].max() >= len(metadata["shape_names"]):
        yield f"array shape: object {arrays['shape'].max()} of {len(metadata['shape_names'])} in metadata.json"
    if {"mask", "visible"} <= set(arrays) and (arrays["visible"] & ~arrays["mask"][:, None]).any():
        yield "array visible: an object that mask denies is visible"


def _digest(features: Arrays) -> str:
    return features["shard_digest"].tobytes().hex()


def _line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
