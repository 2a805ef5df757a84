"""The arrays of a shard, each declared once: type, shape and range, which are checked whenever a shard is read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from envs.workspace import MAXIMUM_OBJECTS, POINTS_PER_OBJECT, object_slots

FARTHEST = 100.0  # metres; the table ends before 1
MOST = {"E": 10_000, "S": 10_000, "M": MAXIMUM_OBJECTS, "P": POINTS_PER_OBJECT, "F": 4096}  # of each dimension


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
    "features": Declared("float32", (*STATES, "F"), -2.0, 2.0),
    "shard_digest": Declared("uint8", (32,), 0, 255),
}
BESIDE = ("shard_digest", "features")  # of files beside the shards, see `cavin_pyro.data.features`


def check_file(file: h5py.File, configuration: Mapping[str, Any]) -> None:
    """Check types and shapes of all declared arrays of a file, before any is read.

    Args:
        configuration: of the collection, which tells S, E and M. What it lacks, the arrays must agree on.

    Raises:
        ValueError: one does not fit; or one lies in another file, to which HDF5 can link.
    """
    options = {"E": "episodes_per_shard", "S": "steps", "M": "maximum_objects"}
    sizes = {name: configuration[option] for name, option in options.items() if option in configuration}
    if "M" in sizes:
        sizes["M"] = object_slots(sizes["M"])
    for name in sorted(file, key=lambda one: list(ARRAYS).index(one) if one in ARRAYS else -1):
        array = file[name] if isinstance(file.get(name, getlink=True), h5py.HardLink) else None
        if not isinstance(array, h5py.Dataset) or array.is_virtual or array.external:
            raise ValueError(f"{name} is no array in this file")
        if name in ARRAYS:
            _check_shape(name, array, sizes)


def _check_shape(name: str, array: h5py.Dataset, sizes: dict[str, int]) -> None:
    declared = ARRAYS[name]
    if array.dtype != np.dtype(declared.dtype):
        raise ValueError(f"{name} has type {array.dtype}, not {declared.dtype}")
    if len(array.shape) == len(declared.dimensions):
        for dimension, size in zip(declared.dimensions, array.shape, strict=True):
            if dimension == "S+1":
                sizes.setdefault("S", size - 1)
            elif isinstance(dimension, str):
                sizes.setdefault(dimension, size)
    wanted = [_size(dimension, sizes) for dimension in declared.dimensions]
    if list(array.shape) != wanted or any(size > MOST[one] for one, size in sizes.items()):
        raise ValueError(f"{name} has shape {list(array.shape)}, not {wanted}")


def _size(dimension: str | int, sizes: Mapping[str, int]) -> Any:
    if dimension == "S+1" and "S" in sizes:
        return sizes["S"] + 1
    return sizes.get(dimension, dimension) if isinstance(dimension, str) else dimension


def check_values(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Check that the values of declared arrays are finite and within their ranges.

    Raises:
        ValueError: some are not.
    """
    for name, array in arrays.items():
        declared = ARRAYS.get(name)
        if declared is None or array.dtype == np.bool_ or array.size == 0:
            continue
        low, high = array.min(), array.max()  # NaN if any is
        if not (declared.low <= low and high <= declared.high):
            raise ValueError(f"{name} has values outside of {declared.low:g} to {declared.high:g}: {low:g} to {high:g}")


def padded(arrays: Mapping[str, NDArray[Any]], objects: int) -> dict[str, NDArray[Any]]:
    """Declared arrays of a shard with room for M = `objects`.

    Raises:
        ValueError: one has room for more.
    """
    wider = {}
    for name, array in arrays.items():
        sizes = zip(ARRAYS[name].dimensions, array.shape, strict=True)
        ends = [(0, objects - size if dimension == "M" else 0) for dimension, size in sizes]
        if np.min(ends) < 0:
            raise ValueError(f"{name} has room for more than {objects} objects, of which the metadata tell")
        wider[name] = np.pad(array, ends, constant_values=ARRAYS[name].padding) if np.any(ends) else array
    return wider
