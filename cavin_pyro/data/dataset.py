"""Collected episodes on disk: a folder of HDF5 files, one per shard of episodes, and a metadata file.

A shard is written under a temporary name and then renamed, so each file is whole or absent; HDF5's Fletcher-32
checksums find a shard that was damaged later. Letters: E episodes, S pushes, M objects (padded), P points.

    centers [E, S+1, M, 3] metres       clouds [E, S+1, M, P, 3] metres from the centre, half precision
    visible [E, S+1, M]                 mask [E, M]
    actions [E, S, 4] normalised        moved [E, S, M] metres, from the simulator
    unsafe, ineffective, fallen [E, S]  length [E] pushes made; what follows is padding
    target [E, S], angle [E, S]         the policy's intent (radians)
    shape, scale, mass, friction [E, M] object parameters; shape indexes `shape_names` in the metadata
    episode [E]                         number of the episode, which with the root seed makes its seed

Episodes of another world have no clouds, and of each object a feature in their place (`WORLD_ARRAYS`). Their
metadata hold its `space`, so that training needs no simulator. Letters: P numbers of a position, F of a feature, A of
an action.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.envs.tabletop.workspace import MAXIMUM_OBJECTS, OBJECT_SLOTS, POINTS_PER_OBJECT, object_slots
from cavin_pyro.models.checks import check_number
from cavin_pyro.models.space import Space
from cavin_pyro.storage.files import atomic_write, file_digest, read_json, write_json

FORMAT = "cavin_pyro episodes"
FORMAT_VERSION = 1
COLLECT = "python -m cavin_pyro.collect"
COUNTS = ("shards", "episodes", "transitions")
FARTHEST = 100.0  # metres; the table ends before 1
FINITE = 3e38  # the largest of float32, about
LARGEST = {"E": 10_000, "S": 10_000, "M": MAXIMUM_OBJECTS, "P": POINTS_PER_OBJECT, "F": 4096, "A": 4096}

Arrays = dict[str, NDArray[Any]]
UNREADABLE = (OSError, KeyError, RuntimeError, ValueError, TypeError, MemoryError)  # what h5py raises


@dataclass(frozen=True)
class Declared:
    """An array: its type, its dimensions (E episodes, S pushes, S+1 states, M objects, P points), and its range.

    `padding`: its value where there is no object.
    """

    dtype: str
    dimensions: tuple[str | int, ...]
    low: float = -FARTHEST
    high: float = FARTHEST
    padding: int = 0


OBJECTS, PUSHES, STATES = ("E", "M"), ("E", "S"), ("E", "S+1", "M")
ARRAYS = {
    "centers": Declared("float32", (*STATES, 3)),
    "clouds": Declared("float16", (*STATES, "P", 3)),
    "visible": Declared("bool", STATES),
    "mask": Declared("bool", OBJECTS),
    "actions": Declared("float32", (*PUSHES, 4), -1.0, 1.0),
    "moved": Declared("float32", (*PUSHES, "M"), 0.0),
    **{name: Declared("bool", PUSHES) for name in ("unsafe", "ineffective", "fallen")},
    "length": Declared("int64", ("E",), 0),
    "target": Declared("int8", PUSHES, -1),
    "angle": Declared("float32", PUSHES),
    "shape": Declared("int8", OBJECTS, -1, 127, padding=-1),
    "scale": Declared("float32", OBJECTS, 0.0),
    "mass": Declared("float32", OBJECTS, 0.0),
    "friction": Declared("float32", OBJECTS, 0.0),
    "episode": Declared("int64", ("E",), 0, float("inf")),
}
FEATURES = {  # of files beside the shards, see `cavin_pyro.data.features`
    "features": Declared("float32", (*STATES, "F"), -2.0, 2.0),
    "shard_digest": Declared("uint8", (32,), 0, 255),
}
WORLD_ARRAYS = {
    "centers": Declared("float32", (*STATES, "P"), -FINITE, FINITE),
    "features": Declared("float32", (*STATES, "F"), -FINITE, FINITE),
    "mask": ARRAYS["mask"],
    "actions": Declared("float32", (*PUSHES, "A"), -1.0, 1.0),
    "length": ARRAYS["length"],
    "episode": ARRAYS["episode"],
}
DECLARED = ARRAYS | FEATURES


def space_of(metadata: Mapping[str, Any]) -> Space | None:
    """The space of a dataset's world; None of the tabletop, whose geometry makes the features."""
    section = metadata["configuration"].get("space")
    return None if section is None else Space(**section)


def check_tabletop(folders: Sequence[Path], what: str) -> None:
    """Raise a `UserError` for a dataset of another world; `what` says why it must be of the tabletop."""
    for folder in folders:
        if "world" in (made := read_metadata(folder)["configuration"]):
            raise UserError(f"{folder} has episodes of {made['world']['_target_']}, and {what}: choose another dataset")


def shard_path(folder: Path, number: int) -> Path:
    """The path of a shard."""
    return folder / f"episodes-{number:05d}.h5"


def write_shard(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write one shard atomically; equal arrays give equal bytes."""
    stored = {"chunks": True, "compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
    # Built in memory, because HDF5 raises errors of its own on a full disk.
    with h5py.File("shard", "w", libver="v110", driver="core", backing_store=False) as file:
        for name in sorted(arrays):
            file.create_dataset(name, data=arrays[name], **stored)
        file.flush()
        content = file.id.get_file_image()
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def read_shard(path: Path, names: Sequence[str] | None = None, *, metadata: Mapping[str, Any] | None = None) -> Arrays:
    """Read one shard, or some of its arrays; types, shapes and ranges are checked.

    `metadata`: of the dataset, with which the numbers of episodes, pushes and objects must agree. Raises UserError: the
    file is missing, truncated, damaged or not a shard; it is named.
    """
    metadata = metadata or {}
    configuration, arrays, where = metadata.get("configuration", {}), Arrays(), ""
    declared = WORLD_ARRAYS if "space" in configuration else DECLARED
    try:
        with h5py.File(path, "r") as file:
            check_file(file, configuration, declared)
            for name in sorted(file) if names is None else names:
                where = f"array {name}: "
                arrays[name] = file[name][()]
                check_values(name, arrays[name], declared)
        where = ""
        _check_agreement(arrays, metadata)
    except UNREADABLE as error:
        defect = f"{where}{str(error).splitlines()[0]}" if path.exists() else "it is missing"
        raise UserError(f"shard {path} is missing or corrupt ({defect}): run its {COLLECT} again") from error
    return arrays


def _check_agreement(arrays: Arrays, metadata: Mapping[str, Any]) -> None:
    """Raise a ValueError for numbers of a shard that contradict its other arrays or the metadata."""
    if {"length", "actions"} <= set(arrays) and arrays["length"].max() > (pushes := arrays["actions"].shape[1]):
        raise ValueError(f"array length: {arrays['length'].max()} pushes in an episode of {pushes}")
    if {"target", "mask"} <= set(arrays) and arrays["target"].max() >= (slots := arrays["mask"].shape[1]):
        raise ValueError(f"array target: object {arrays['target'].max()} of {slots}")
    if "mask" in arrays and not arrays["mask"].any(axis=-1).all():
        raise ValueError("array mask: an episode without an object")
    for name, least in (("shape", 0), ("scale", 1e-6)):
        if {name, "mask"} <= set(arrays) and (arrays[name][arrays["mask"]] < least).any():
            raise ValueError(f"array {name}: {arrays[name][arrays['mask']].min()} of an object that is there")
    known = len(metadata.get("shape_names", ()))
    if "shape" in arrays and "shape_names" in metadata and arrays["shape"].max() >= known:
        raise ValueError(f"array shape: object {arrays['shape'].max()} of {known} in metadata.json")


def check_file(file: h5py.File, configuration: Mapping[str, Any], declared: Mapping[str, Declared]) -> None:
    """Check types and shapes of all declared arrays of a file, before any is read.

    `configuration`: of the collection, which tells E, S and M, and of a world P, F and A. What it lacks, the arrays
    must agree on. Raises ValueError: one does not fit; or one lies in another file, to which HDF5 can link.
    """
    options = {"E": "episodes_per_shard", "S": "steps", "M": "maximum_objects"}
    if space := space_of({"configuration": configuration}):
        options |= {"M": "objects", "F": "features"}
    sizes = {name: configuration[option] for name, option in options.items() if option in configuration}
    if space:
        sizes |= {"P": space.positions, "A": space.actions}
    elif "M" in sizes:
        sizes["M"] = object_slots(sizes["M"])
    for name in sorted(file, key=lambda one: list(declared).index(one) if one in declared else -1):
        array = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
        if not isinstance(array, h5py.Dataset) or array.is_virtual or array.external:
            raise ValueError(f"{name} is no array in this file")
        if name in declared:
            _check_shape(name, array, declared[name], sizes)


def _check_shape(name: str, array: h5py.Dataset, declared: Declared, sizes: dict[str, int]) -> None:
    if array.dtype != np.dtype(declared.dtype):
        raise ValueError(f"{name} has type {array.dtype}, not {declared.dtype}")
    if len(array.shape) == len(declared.dimensions):
        for dimension, size in zip(declared.dimensions, array.shape, strict=True):
            if dimension == "S+1":
                sizes.setdefault("S", size - 1)
            elif isinstance(dimension, str):
                sizes.setdefault(dimension, size)
    known = sizes | ({"S+1": sizes["S"] + 1} if "S" in sizes else {})
    wanted = [known.get(one, one) if isinstance(one, str) else one for one in declared.dimensions]
    if list(array.shape) != wanted or any(size > LARGEST[one] for one, size in sizes.items()):
        raise ValueError(f"{name} has shape {list(array.shape)}, not {wanted}")


def check_values(name: str, array: NDArray[Any], table: Mapping[str, Declared] = DECLARED) -> None:
    """Check that the values of an array that `table` declares are finite and within their range.

    Raises ValueError: some are not.
    """
    declared = table.get(name)
    if declared is None or array.dtype == np.bool_ or array.size == 0:
        return
    low, high = array.min(), array.max()  # NaN if any is
    if not (declared.low <= low and high <= declared.high):
        raise ValueError(f"{name} has values outside of {declared.low:g} to {declared.high:g}: {low:g} to {high:g}")


def padded(arrays: Mapping[str, NDArray[Any]], objects: int) -> Arrays:
    """Declared arrays of a shard with room for M = `objects`. Raises UserError: one has room for more."""
    wider = {}
    for name, array in arrays.items():
        sizes = zip(DECLARED[name].dimensions, array.shape, strict=True)
        ends = [(0, objects - size if dimension == "M" else 0) for dimension, size in sizes]
        if np.min(ends) < 0:
            raise UserError(f"{name} has room for more than the {objects} objects of the metadata: collect it again")
        wider[name] = np.pad(array, ends, constant_values=DECLARED[name].padding) if np.any(ends) else array
    return wider


def write_metadata(folder: Path, metadata: Mapping[str, Any]) -> None:
    """Write the dataset's metadata atomically."""
    write_json(folder / "metadata.json", {"format": FORMAT, "version": FORMAT_VERSION, **metadata})


def read_metadata(folder: Path) -> dict[str, Any]:
    """Read and check a dataset's metadata.

    Raises UserError: there is no dataset, or it has another format or version, or it is damaged or cannot be read.
    """
    path = folder / "metadata.json"
    if not path.exists():
        raise UserError(f"no dataset in {folder}: make one with {COLLECT} output={folder}")
    metadata = read_json(path)
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        raise UserError(f"{path} does not describe a dataset of this program")
    if metadata.get("version") != FORMAT_VERSION:
        raise UserError(
            f"dataset {folder} has format version {metadata.get('version')}, this program reads {FORMAT_VERSION}: "
            "collect it again"
        )
    with user_input(where=f"{path} is damaged, collect the dataset again"):
        _check_metadata(metadata, files=sum(1 for _ in folder.glob("episodes-*.h5")))
    return metadata


def _check_metadata(metadata: Mapping[str, Any], *, files: int) -> None:
    configuration = metadata["configuration"]
    usual = {"steps": None, "episodes_per_shard": 1, "maximum_objects": 1}
    if "space" in configuration:
        space_of(metadata)
        usual = {"objects": None, "features": None, **usual}
        if "_target_" not in configuration["world"]:
            raise ValueError("its world has no _target_")
    for name in COUNTS:
        check_number(name, metadata.get(name), 1, whole=True)
    for name, value in usual.items():
        most = MAXIMUM_OBJECTS if name == "maximum_objects" else math.inf
        check_number(name, configuration.get(name, value), 1, most, whole=True)
    names = metadata.get("shape_names", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError("shape_names must be a list of names")
    if not isinstance(configuration.get("ranges") or {}, dict):
        raise ValueError("ranges must be a table")
    shards, episodes, transitions = (metadata[name] for name in COUNTS)
    each = configuration.get("episodes_per_shard")
    if (each and episodes != shards * each) or transitions > episodes * configuration["steps"]:
        raise ValueError(f"{shards} files have not {episodes} episodes with {transitions} pushes")
    if shards > files + 1000:  # fewer that are missing are named one by one when the rest is used
        raise ValueError(f"it counts {shards} files of episodes, but {files} are there")
    if type(seed_of(metadata)) is not (str if "sha256" in configuration else int):
        raise ValueError("seed must be a whole number")


def seed_of(metadata: Mapping[str, Any]) -> Any:
    """The root seed of a collection; of imported episodes the SHA-256 of what they were read from."""
    return metadata["configuration"].get("sha256", metadata["configuration"].get("seed"))


def slots_of(metadata: Mapping[str, Any]) -> int:
    """M, for how many objects the files of a dataset have room."""
    configuration = metadata["configuration"]
    if "space" in configuration:
        return int(configuration["objects"])
    return object_slots(configuration.get("maximum_objects", OBJECT_SLOTS))


def content_record(folder: Path) -> dict[str, Any]:
    """What identifies a dataset's content: `transitions`, `episodes`, `configuration`, `made_by` and `fingerprint`.

    The fingerprint is of the first shard's bytes: twelve hexadecimal digits, equal for equal configuration, program and
    simulator. Raises UserError: no dataset, or this shard cannot be read.
    """
    metadata = read_metadata(folder)
    names = ("transitions", "episodes", "configuration", "made_by")
    known = {name: metadata.get(name) for name in names}
    return {**known, "fingerprint": shard_digest(shard_path(folder, 0))[:12]}


def shard_digest(path: Path) -> str:
    """The SHA-256 of a shard's bytes: hexadecimal digits. It takes 3 ms for 2 MB.

    Raises UserError: the file cannot be read.
    """
    if path.exists() and not path.is_file():
        raise UserError(f"shard {path} is no regular file: run its {COLLECT} again")
    try:
        return file_digest(path)
    except OSError as error:
        raise UserError(f"shard {path} is missing or corrupt ({error.strerror}): run its {COLLECT} again") from error


def check_distinct(folders: Sequence[Path]) -> None:
    """Check that no dataset is given twice, so that no episode counts twice and none is in training and validation.

    Raises UserError: two begin with the same shard.
    """
    known: dict[str, Path] = {}
    for folder in folders:
        content = shard_digest(shard_path(folder, 0))
        if content in known:
            raise UserError(f"data names the same episodes twice, {known[content]} and {folder}: name them once")
        known[content] = folder


def iterate_shards(folder: Path, names: Sequence[str]) -> Iterator[tuple[int, Arrays]]:
    """Yield (number, arrays) of a dataset's shards in order. names: arrays to read.

    Raises UserError: no dataset, a corrupt shard, or one that repeats an episode of another.
    """
    metadata, known = read_metadata(folder), set[int]()
    for number in range(metadata["shards"]):
        path = shard_path(folder, number)
        arrays = read_shard(path, ("episode", *names), metadata=metadata)
        for episode in arrays["episode"].tolist():
            if episode in known:
                raise UserError(f"shard {path} repeats episode {episode}: delete it and run its {COLLECT} again")
            known.add(episode)
        yield number, arrays
