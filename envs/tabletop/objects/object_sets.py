"""Sets of objects: ten builtin shapes, scans of real objects from a folder, both together, or random shapes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from cavin_pyro.envs.tabletop.files import assets_folder, process_folder
from cavin_pyro.envs.tabletop.objects.shapes import (
    BUILTIN_NAMES,
    RANDOM_NAMES,
    Shape,
    builtin_shape,
    plain_name,
    random_shape,
    write_mesh,
)
from cavin_pyro.models.checks import check_choice

SCANS = "ycb"  # the folder's name within the assets, and the prefix of its objects' names
FARTHEST = 100.0  # metres; larger numbers are not metres
_GET = f"get them with: python -m cavin_pyro.assets {SCANS} --to DIR"


@dataclass(frozen=True)
class ObjectAsset:
    """An object of a set.

    Attributes:
        name: in its set. mass: kilograms, as published.
        radius: metres from the origin to the farthest vertex.
        collision: Wavefront file, a group per convex part. visual: Wavefront file for the camera. Both in
            metres, the origin at the centre of mass.
        inertia: (x, y, z) kilograms times square metres at that mass and size, about the file's axes; None: the
            simulator computes that of the bounding box.
    """

    name: str
    mass: float
    radius: float
    collision: Path
    visual: Path
    inertia: tuple[float, float, float] | None = None

    def inertia_of(self, mass: float, scale: float) -> tuple[float, float, float] | None:
        """The inertia at another mass (kilograms) and size (factor); it is proportional to mass times area."""
        if self.inertia is None:
            return None
        factor = mass / self.mass * scale**2
        x, y, z = (value * factor for value in self.inertia)
        return x, y, z


@runtime_checkable
class ObjectSet(Protocol):
    """Objects by name. A name is the object's own (`mug`), or has the set's as a prefix (`ycb/mug`)."""

    @property
    def names(self) -> tuple[str, ...]:
        """All names, in an order that does not change from run to run."""

    def asset(self, name: str) -> ObjectAsset:
        """One object. Raises ValueError: no object has that name, or its files cannot be used."""


class NamedObjects:
    """An object set from a function for each name, which makes the object of that name when it is asked for."""

    def __init__(self, makers: Mapping[str, Callable[[str], ObjectAsset]]) -> None:
        self.makers, self.names = makers, tuple(makers)

    def asset(self, name: str) -> ObjectAsset:
        if name not in self.makers:
            raise ValueError(f"unknown object {name!r}: choose from {listed(self.names)}")
        return self.makers[name](name)


def shape_objects(names: Iterable[str], build: Callable[[str], Shape]) -> NamedObjects:
    """Shapes of `cavin_pyro.envs.tabletop.objects.shapes`, each written to a temporary folder when it is used."""

    def asset(name: str) -> ObjectAsset:
        shape = build(name)
        mesh = write_mesh(shape, _mesh_folder())
        return ObjectAsset(shape.name, shape.mass, shape.radius, collision=mesh, visual=mesh)

    return NamedObjects(dict.fromkeys(names, asset))


def scanned_objects(assets: str | Path | None) -> NamedObjects:
    """The objects of the folder `assets/ycb`, called `ycb/NAME`; every file is checked.

    The folder has for each object `NAME.obj` (visual mesh) and `NAME_vhacd.obj` (collision mesh: one convex part per
    group), in metres, z up, with the origin at the centre of mass, and one `meta.json` with names, masses (kilograms)
    and inertias (kilograms times square metres):

        {"mug": {"mass": 0.118, "inertia_diag": [1.07e-4, 1.11e-4, 1.47e-4]}, ...}

    `python -m cavin_pyro.assets ycb --to DIR` makes such a folder of the YCB objects. Raises ValueError: no folder was
    named, or a file in it is missing or damaged; the message says which command makes it.
    """
    if assets is None:
        raise ValueError(f"these objects are scans, in no folder that was named: give env.assets=DIR; {_GET}")
    folder = assets_folder(assets) / SCANS
    try:
        manifest = json.loads((folder / "meta.json").read_text(encoding="utf-8"))
        scans = {f"{SCANS}/{name}": _scan(folder, name, values) for name, values in manifest.items()}
        if not scans:
            raise ValueError("meta.json lists no object")
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
        what = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else f"damaged: {error!r}"
        get = _GET.replace("DIR", str(folder.parent))
        raise ValueError(f"the objects in {folder} cannot be used ({what[:200]}); {get}") from error
    return NamedObjects(dict.fromkeys(scans, scans.__getitem__))


BUILTIN = shape_objects(BUILTIN_NAMES, builtin_shape)
OBJECT_SETS: dict[str, Callable[[str | Path | None], ObjectSet]] = {
    "builtin": lambda assets: BUILTIN,
    "ycb": scanned_objects,
    "mixed": lambda assets: NamedObjects({**BUILTIN.makers, **scanned_objects(assets).makers}),
    "random": lambda assets: shape_objects(RANDOM_NAMES, random_shape),
}
"""Factories of object sets by name; their argument is the folder of assets, or None."""


def load_object_set(name: str | ObjectSet, assets: str | Path | None = None) -> ObjectSet:
    """The set of that name, or the given one.

    Raises ValueError: the name is unknown, or the set needs assets that are not there.
    """
    if not isinstance(name, str):
        return name
    check_choice("object set", name, OBJECT_SETS)
    return OBJECT_SETS[name](assets)


def chosen(names: Sequence[str], objects: ObjectSet) -> tuple[str, ...]:
    """Objects of the set by names, with or without the set's prefix: in a mixed set `mug` means both mugs.

    Raises ValueError: an unknown name; the message lists the valid ones.
    """
    if not objects.names:
        raise ValueError(f"{type(objects).__name__} has no objects: its names are empty")
    found = []
    for name in names:
        meant = [one for one in objects.names if name in (one, plain_name(one))]
        if not meant:
            valid = dict.fromkeys(plain_name(one) for one in objects.names)
            raise ValueError(f"unknown object {name!r}: choose from {listed(valid)}")
        found += meant
    return tuple(found)


def listed(names: Iterable[str]) -> str:
    """Names for a one-line message: all of them, or both ends of a long list."""
    every = list(names)
    return ", ".join(every if len(every) <= 40 else [*every[:2], "...", every[-1]])


@cache
def _mesh_folder() -> Path:
    return process_folder("meshes")


def _scan(folder: Path, name: str, values: dict[str, Any]) -> ObjectAsset:
    """Read what a folder has of an object.

    Raises OSError, ValueError, TypeError, KeyError, OverflowError: something is missing or damaged.
    """
    collision, visual = folder / f"{name}_vhacd.obj", folder / f"{name}.obj"
    x, y, z = map(float, values["inertia_diag"])
    mass = float(values["mass"])
    lines = collision.read_text(encoding="utf-8").splitlines()
    vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=np.float64).reshape(-1, 3)
    if plain_name(name) != name or not all(0.0 < number < np.inf for number in (mass, x, y, z)):
        raise ValueError(f"{name} needs a mass and an inertia_diag of three numbers")
    if not (len(vertices) and (np.abs(vertices) < FARTHEST).all()):  # also if one is no number
        raise ValueError(f"the vertices of {collision.name} are no points in metres")
    parts, faces = (sum(line.startswith(kind) for line in lines) for kind in ("o ", "f "))
    if not faces or parts != values.get("nparts", parts) or "\nf " not in visual.read_text(encoding="utf-8"):
        raise ValueError(f"{collision.name} or {visual.name} is cut")
    radius = float(np.linalg.norm(vertices, axis=1).max())
    return ObjectAsset(f"{SCANS}/{name}", mass, radius, collision.absolute(), visual.absolute(), (x, y, z))
