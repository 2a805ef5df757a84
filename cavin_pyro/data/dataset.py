"""Collected episodes on disk: a folder of HDF5 files, one per shard of episodes, and a metadata file.

A shard is written under a temporary name and then renamed, so each file is whole or absent; HDF5's Fletcher-32
checksums find a shard that was damaged later. Letters: E episodes, S pushes, M objects (padded).

    centers [E, S+1, M, 3] metres       clouds [E, S+1, M, 256, 3] metres from the centre, half precision
    visible [E, S+1, M]                 mask [E, M]
    actions [E, S, 4] normalised        moved [E, S, M] metres, from the simulator
    unsafe, ineffective, fallen [E, S]  length [E] pushes made; what follows is padding
    target [E, S], angle [E, S]         the policy's intent (radians)
    shape, scale, mass, friction [E, M] object parameters; shape indexes `shape_names` in the metadata
    episode [E]                         number of the episode, which with the root seed makes its seed
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cavin_pyro.config.errors import UserError
from cavin_pyro.data.declaration import check_file, check_values
from cavin_pyro.data.sources import check_sources, has_possible_objects, source_of_shards, sources_of
from cavin_pyro.storage.files import atomic_write, file_digest, read_json, write_json
from envs.workspace import MAXIMUM_OBJECTS

FORMAT = "cavin_pyro episodes"
FORMAT_VERSION = 1

COLLECT_AGAIN = "collect it again, with the same options and repair=true"
MOST_LOST = 1000  # files; each that is missing is named when the rest is used

Arrays = dict[str, NDArray[Any]]


class EmptyDatasetError(UserError):
    """A dataset that holds no episode, which collect begins again."""


class CorruptShardError(UserError):
    """A shard that is missing or corrupt.

    Attributes:
        defect: the same line without what to do about it, for commands that are doing that.
    """

    defect: str

    @classmethod
    def of(cls, path: Path, said: str, *, merged: bool = False) -> CorruptShardError:
        """The error about one shard. merged: its dataset, which collect refuses to repair, was made of others."""
        defect = f"shard {path} is missing or corrupt ({said})"
        advice = (
            "merge the datasets again of which it was made"
            if merged
            else f"collect it again with python -m cavin_pyro.collect output={path.parent} repair=true and the other "
            "options of that collection"
        )
        # Not in a constructor of its own, with which an error could not leave the process that raised it.
        error = cls(f"{defect}: {advice}, or train on the rest with skip_corrupt=true")
        error.defect = defect
        return error


def shard_path(folder: Path, number: int) -> Path:
    """The path of a shard."""
    return folder / f"episodes-{number:05d}.h5"


def write_shard(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write one shard atomically; equal arrays give equal bytes."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(_shard_bytes(arrays))


def _shard_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    # Built in memory, because HDF5 raises errors of its own on a full disk.
    with h5py.File("shard", "w", libver="v110", driver="core", backing_store=False) as file:
        for name in sorted(arrays):
            file.create_dataset(
                name,
                data=arrays[name],
                chunks=True,
                compression="gzip",
                compression_opts=1,
                shuffle=True,
                fletcher32=True,
            )
        file.flush()
        return file.id.get_file_image()


def read_shard(
    path: Path, names: tuple[str, ...] | None = None, *, metadata: Mapping[str, Any] | None = None
) -> Arrays:
    """Read one shard, or some of its arrays; types, shapes and ranges are checked (`cavin_pyro.data.declaration`).

    Args:
        metadata: of the dataset, with which the numbers of episodes and of pushes must agree.

    Raises:
        CorruptShardError: the file is missing, truncated, damaged or not a shard; it is named.
    """
    configuration = (metadata or {}).get("configuration", {})
    try:
        with h5py.File(path, "r") as file:
            check_file(file, configuration)
            arrays = {name: file[name][()] for name in (names or sorted(file))}
        check_values(arrays)
        return arrays
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, MemoryError) as error:
        raise CorruptShardError.of(path, str(error).splitlines()[0], merged="sources" in (metadata or {})) from error


def write_metadata(folder: Path, metadata: Mapping[str, Any]) -> None:
    """Write the dataset's metadata atomically."""
    write_json(folder / "metadata.json", {"format": FORMAT, "version": FORMAT_VERSION, **metadata})


def read_metadata(folder: Path) -> dict[str, Any]:
    """Read and check a dataset's metadata.

    Raises:
        UserError: there is no dataset, or it has another format or version, or it is damaged or cannot be read.
        EmptyDatasetError: it holds no episode.
    """
    path = folder / "metadata.json"
    try:
        is_file, is_dataset = folder.is_file(), path.exists()
    except OSError as error:  # a name that is too long, or a folder that may not be looked into
        raise UserError(
            f"dataset {folder} cannot be read: {error.strerror}: give a folder that collect wrote"
        ) from error
    if is_file:
        raise UserError(f"no dataset in {folder}, which is a file: give the folder that collect has written")
    if not is_dataset:
        raise UserError(
            f"no dataset in {folder}: make one with python -m cavin_pyro.collect transitions=100000 output={folder}"
        )
    metadata = read_json(path)
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        raise UserError(f"{path} does not describe a dataset of this program")
    if metadata.get("version") != FORMAT_VERSION:
        raise UserError(
            f"dataset {folder} has format version {metadata.get('version')}, this program reads {FORMAT_VERSION}: "
            "collect it again"
        )
    counts = [metadata.get(name) for name in ("shards", "episodes", "transitions")]
    if not all(type(count) is int for count in counts) or not isinstance(metadata.get("configuration"), dict):
        raise UserError(f"{path} is damaged: configuration or counts are missing; collect the dataset again")
    if metadata["shards"] < 1:
        raise EmptyDatasetError(
            f"dataset {folder} is empty: collect it again with python -m cavin_pyro.collect output={folder}"
        )
    _check_forms(path, metadata)
    _check_counts(path, metadata)
    check_sources(path, metadata)
    return metadata


def _check_forms(path: Path, metadata: Mapping[str, Any]) -> None:
    """Check what is looked into without being counted; older datasets lack some of it."""
    if not isinstance(metadata["configuration"].get("ranges") or {}, dict):
        raise UserError(f"{path} is damaged: ranges must be a table; collect the dataset again")
    names = metadata.get("shape_names", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise UserError(f"{path} is damaged: shape_names must be a list of names; collect the dataset again")


def _check_counts(path: Path, metadata: Mapping[str, Any]) -> None:
    """Check that a dataset's counts agree with one another and with the files that are there."""
    configuration = metadata["configuration"]
    steps, each = configuration.get("steps"), configuration.get("episodes_per_shard", 1)
    if not all(type(size) is int and size >= 1 for size in (steps, each)):
        raise UserError(f"{path} is damaged: steps and episodes_per_shard must be whole numbers; collect it again")
    if not has_possible_objects(configuration):
        raise UserError(f"{path} is damaged: maximum_objects must be from 1 to {MAXIMUM_OBJECTS}; collect it again")
    shards, episodes, transitions = (metadata[name] for name in ("shards", "episodes", "transitions"))
    wrong = "episodes_per_shard" in configuration and episodes != shards * each
    if wrong or not 0 <= transitions <= episodes * steps:
        raise UserError(
            f"{path} is damaged: {shards} files have not {episodes} episodes with {transitions} pushes; "
            "collect the dataset again"
        )
    there = sum(1 for _ in path.parent.glob("episodes-*.h5"))
    if shards > there + MOST_LOST:
        raise UserError(f"{path} counts {shards} files of episodes, but {there} are there: collect the dataset again")


def content_records(folder: Path) -> list[dict[str, Any]]:
    """What identifies a dataset's content: a record for each collection in it, which is one unless it was merged.

    Each has `transitions`, `episodes`, `configuration`, `made_by`, and the `fingerprint` of the first shard's bytes:
    twelve hexadecimal digits, equal for equal configuration, program and simulator.

    Raises:
        UserError: no dataset, or one of these shards cannot be read.
    """
    metadata, first, records = read_metadata(folder), 0, []
    for source in sources_of(metadata):
        names = ("transitions", "episodes", "configuration", "made_by")
        records.append({**{name: source[name] for name in names}, "fingerprint": _fingerprint(folder, first)})
        first += source["shards"]
    return records


def _fingerprint(folder: Path, shard: int) -> str:
    return shard_digest(shard_path(folder, shard))[:12]


def shard_digest(path: Path) -> str:
    """The SHA-256 of a shard's bytes: hexadecimal digits. It takes 3 ms for 2 MB.

    Raises:
        UserError: the file cannot be read.
    """
    try:
        return file_digest(path)
    except OSError as error:
        raise UserError(f"shard {path} cannot be read ({error.strerror}): collect it again") from error


def check_distinct(folders: Sequence[Path]) -> None:
    """Check that no dataset is given twice, so that no episode counts twice and none is in training and validation.

    Raises:
        UserError: two begin with the same shard, or have parts that do.
    """
    known: dict[str, Path] = {}
    for folder in folders:
        metadata, first = read_metadata(folder), 0  # tells whether there is a dataset at all
        for source in sources_of(metadata):
            path = shard_path(folder, first)
            fingerprint = _fingerprint(folder, first) if path.exists() else str(path.resolve())
            if fingerprint in known:
                raise UserError(
                    f"data names the same episodes twice, {known[fingerprint]} and {folder}: name them once"
                )
            known[fingerprint] = folder
            first += source["shards"]


class EpisodeNumbers:
    """The numbers of a dataset's episodes, each of which belongs to one episode of a collection."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._sources = folder, source_of_shards(read_metadata(folder))
        self._seen: dict[int, set[int]] = {}

    def add(self, number: int, episodes: NDArray[np.int64]) -> None:
        """Add those of a shard.

        Raises:
            UserError: an earlier shard has one of them.
        """
        if repetition := self.repetition(number, episodes):
            raise UserError(
                f"shard {shard_path(self._folder, number)} {repetition}: "
                "delete it and collect again with repair=true to rebuild it"
            )

    def repetition(self, number: int, episodes: NDArray[np.int64]) -> str | None:
        """What a shard repeats, such as "repeats episode 3"; if it repeats nothing, add its episodes."""
        seen = self._seen.setdefault(self._sources[number], set())
        if repeated := sorted(seen & set(episodes.tolist())):
            return f"repeats episode {repeated[0]}"
        if len(set(episodes.tolist())) < len(episodes):
            return "repeats episodes"
        seen |= set(episodes.tolist())
        return None


def iterate_shards(folder: Path, names: tuple[str, ...], *, skip_corrupt: bool = False) -> Iterator[tuple[int, Arrays]]:
    """Yield (number, arrays) of a dataset's shards in order.

    Args:
        names: arrays to read. skip_corrupt: skip corrupt shards with a message, instead of raising.

    Raises:
        UserError: no dataset, a corrupt shard, or none that is whole.
    """
    metadata, whole = read_metadata(folder), 0
    for number in range(metadata["shards"]):
        try:
            arrays = read_shard(shard_path(folder, number), names, metadata=metadata)
        except CorruptShardError as error:
            if not skip_corrupt:
                raise
            print(f"left out: {error.defect}", flush=True)
            continue
        whole += 1
        yield number, arrays
    if whole == 0:
        raise UserError(f"dataset {folder} has no usable shard: {COLLECT_AGAIN}")
