"""Sets of objects: ten builtin shapes, real scans from a folder, both together, or random shapes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Protocol

from envs.objects.asset import ObjectAsset, listed, plain_name
from envs.objects.random_shapes import RANDOM_NAMES, random_shape
from envs.objects.scans import ScannedObjects
from envs.objects.shapes import BUILTIN_NAMES, Shape, builtin_shape, write_mesh
from envs.process_folder import process_folder


class ObjectSet(Protocol):
    """Objects by name. A name is the object's own (`mug`), or has the set's as a prefix (`ycb/mug`)."""

    @property
    def names(self) -> tuple[str, ...]:
        """All names, in an order that does not change from run to run."""

    def asset(self, name: str) -> ObjectAsset:
        """One object.

        Raises:
            ValueError: no object has that name, or its files cannot be used.
        """


class BuiltinObjects:
    """The ten shapes of `envs.objects.shapes`, written to a temporary folder at their first use."""

    names = BUILTIN_NAMES

    def asset(self, name: str) -> ObjectAsset:
        """See `ObjectSet`."""
        return _asset(builtin_shape(name))


class RandomObjects:
    """The hundred shapes of `envs.objects.random_shapes`, written in the same way."""

    names = RANDOM_NAMES

    def asset(self, name: str) -> ObjectAsset:
        """See `ObjectSet`."""
        return _asset(random_shape(name))


class MixedObjects:
    """Several sets as one.

    Args:
        sets: without common names.
    """

    def __init__(self, *sets: ObjectSet) -> None:
        self._sets = {name: one for one in sets for name in one.names}
        self.names = tuple(self._sets)

    def asset(self, name: str) -> ObjectAsset:
        """See `ObjectSet`."""
        if name not in self._sets:
            raise ValueError(f"unknown object {name!r}: choose from {listed(self.names)}")
        return self._sets[name].asset(name)


OBJECT_SETS: dict[str, Callable[[str | Path | None], ObjectSet]] = {
    "builtin": lambda assets: BuiltinObjects(),
    "ycb": ScannedObjects,
    "mixed": lambda assets: MixedObjects(BuiltinObjects(), ScannedObjects(assets)),
    "random": lambda assets: RandomObjects(),
}
"""Factories of object sets by name; their argument is the folder of assets, or None."""


def load_object_set(name: str | ObjectSet, assets: str | Path | None = None) -> ObjectSet:
    """The set of that name, or the given one.

    Raises:
        ValueError: the name is unknown, or the set needs assets that are not there.
    """
    if not isinstance(name, str):
        return name
    if name not in OBJECT_SETS:
        raise ValueError(f"unknown object set {name!r}: choose from {', '.join(OBJECT_SETS)}")
    return OBJECT_SETS[name](assets)


def chosen(names: Sequence[str], objects: ObjectSet) -> tuple[str, ...]:
    """Objects of the set by names, with or without the set's prefix: in a mixed set `mug` means both mugs.

    Raises:
        ValueError: an unknown name; the message lists the valid ones.
    """
    found = []
    for name in names:
        meant = [one for one in objects.names if name in (one, plain_name(one))]
        if not meant:
            valid = dict.fromkeys(plain_name(one) for one in objects.names)
            raise ValueError(f"unknown object {name!r}: choose from {listed(valid)}")
        found += meant
    return tuple(found)


def _asset(shape: Shape) -> ObjectAsset:
    mesh = write_mesh(shape, _mesh_folder())
    return ObjectAsset(shape.name, shape.mass, shape.radius, collision=mesh, visual=mesh)


@cache
def _mesh_folder() -> Path:
    return process_folder("meshes")
