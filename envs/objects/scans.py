"""Scans of real objects in a folder.

The folder has for each object `NAME.obj` (visual mesh) and `NAME_vhacd.obj` (collision mesh: one convex part per
group), in metres, z up, with the origin at the centre of mass, and one `meta.json` with names, masses (kilograms) and
inertias (kilograms times square metres):

    {"mug": {"mass": 0.118, "inertia_diag": [1.07e-4, 1.11e-4, 1.47e-4]}, ...}

`python -m cavin_pyro.assets ycb --to DIR` makes such a folder of the YCB objects.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from envs.assets import assets_folder
from envs.objects.asset import ObjectAsset, plain_name

SCANS = "ycb"  # the folder's name within the assets, and the prefix of its objects' names
FARTHEST = 100.0  # metres; larger numbers are not metres
_GET = f"get them with: python -m cavin_pyro.assets {SCANS} --to DIR"


class ScannedObjects:
    """The objects of the folder `assets/ycb`, called `ycb/NAME`. The constructor checks every file.

    Raises:
        ValueError: no folder was named, or the folder or a file in it is missing or damaged: the message
            says what is missing, where, and which command makes it.
    """

    def __init__(self, assets: str | Path | None) -> None:
        if assets is None:
            raise ValueError(f"these objects are scans, in no folder that was named: give env.assets=DIR; {_GET}")
        folder = assets_folder(assets) / SCANS
        self._assets = {f"{SCANS}/{name}": _scan(folder, name, values) for name, values in _manifest(folder).items()}
        self.names = tuple(self._assets)

    def asset(self, name: str) -> ObjectAsset:
        """See `envs.objects.object_sets.ObjectSet`."""
        if name not in self._assets:
            raise ValueError(f"unknown object {name!r}: choose from {', '.join(self.names)}")
        return self._assets[name]


def _manifest(folder: Path) -> dict[str, Any]:
    get = _GET.replace("DIR", str(folder.parent))
    try:
        manifest = json.loads((folder / "meta.json").read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"no objects in {folder}: meta.json cannot be read ({error.strerror}); {get}") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{folder / 'meta.json'} is damaged: it is not JSON; {get}") from error
    if not isinstance(manifest, dict) or not manifest:
        raise ValueError(f"{folder / 'meta.json'} is damaged: it names no object; {get}")
    missing = [
        file
        for name in manifest
        for file in (f"{name}.obj", f"{name}_vhacd.obj")
        if plain_name(name) != name or not os.path.isfile(folder / file)
    ]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ValueError(f"the objects in {folder} are incomplete: {missing[0]}{more} missing; {get}")
    return manifest


def _scan(folder: Path, name: str, values: Any) -> ObjectAsset:
    told = values if isinstance(values, dict) else {}
    mass, inertia = told.get("mass"), told.get("inertia_diag")
    if not (isinstance(inertia, list) and len(inertia) == 3 and all(map(_is_positive, [mass, *inertia]))):
        raise ValueError(f"{folder / 'meta.json'} is damaged: {name} needs a mass and an inertia_diag of three numbers")
    collision = folder / f"{name}_vhacd.obj"
    x, y, z = map(float, inertia)
    return ObjectAsset(
        name=f"{SCANS}/{name}",
        mass=float(told["mass"]),
        radius=_radius(collision),
        collision=collision.absolute(),
        visual=(folder / f"{name}.obj").absolute(),
        inertia=(x, y, z),
    )


def _is_positive(value: Any) -> bool:
    """Whether a value in JSON is a positive number, which true is not, nor one that no float holds."""
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= sys.float_info.max


def _radius(mesh: Path) -> float:
    """Metres from the origin to the farthest vertex.

    Raises:
        ValueError: there is no vertex, or one is no point within `FARTHEST`.
    """
    try:
        lines = mesh.read_text(encoding="utf-8").splitlines()
        vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=np.float64)
        if not (np.abs(vertices) < FARTHEST).all():  # also if one is no number
            raise ValueError("no metres")
        return float(np.linalg.norm(vertices.reshape(-1, 3), axis=1).max())
    except (OSError, ValueError) as error:
        raise ValueError(f"{mesh} is damaged: its vertices cannot be read as points in metres") from error
