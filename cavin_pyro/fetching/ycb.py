"""The paper's ten objects of the YCB Object and Model Set (Calli et al. 2015), CC BY 4.0."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from cavin_pyro.config.errors import UserError
from cavin_pyro.envs.tabletop.objects.shapes import RECIPES
from cavin_pyro.fetching import meshes
from cavin_pyro.fetching.install import Files, take
from cavin_pyro.storage.files import read_json, write_json

VISUAL_FACES = 2000
# Scans are larger than what was measured by hand: an open flap, a bulging bag, a mug's handle.
TOLERANCE = 0.013  # metres by which some side may differ from a published one
OVERHANG = 0.030  # metres by which the longest side may exceed the longest published one


SCANS = {  # the folder in the set of each object
    "sugar_box": "004_sugar_box",
    "tomato_soup_can": "005_tomato_soup_can",
    "tuna_fish_can": "007_tuna_fish_can",
    "pudding_box": "008_pudding_box",
    "gelatin_box": "009_gelatin_box",
    "potted_meat_can": "010_potted_meat_can",
    "banana": "011_banana",
    "mug": "025_mug",
    "a_cups": "065-a_cups",
    "rubiks_cube": "077_rubiks_cube",
}

NOTICE = """YCB Object and Model Set: B. Calli, A. Walsman, A. Singh, S. Srinivasa, P. Abbeel, A. M. Dollar, 2015.
https://www.ycbbenchmarks.com, licence CC BY 4.0, https://creativecommons.org/licenses/by/4.0/
Changed: ten objects of it, with fewer faces, moved to the centre of mass, turned, and taken apart into convex parts.
"""


class YcbObjects:
    """A `cavin_pyro.fetching.install.Kind`: one archive and one object a piece."""

    name = "ycb"
    site = "https://ycb-benchmarks.s3.amazonaws.com"
    pieces = {name: f"data/google/{scan}_google_16k.tgz" for name, scan in SCANS.items()}
    wanted: tuple[str, ...] = ("google_16k/nontextured.ply",)

    def make(self, piece: str, files: Files, folder: Path) -> None:
        scan = meshes.read_mesh(take(files, self.wanted[0]), "ply", piece)
        meshes.long_side_along_x(scan)
        _check_size(piece, scan)
        body, (_, _, mass) = meshes.closed(scan), RECIPES[piece]
        body.density = mass / body.volume
        scan.apply_translation(-body.center_mass)
        mesh = meshes.decimated(scan, VISUAL_FACES)
        parts = meshes.convex_parts(mesh)
        _check_parts(piece, mesh, parts)
        meshes.write_parts(folder / f"{piece}.obj", [mesh])
        meshes.write_parts(folder / f"{piece}_vhacd.obj", parts)
        x, y, z = (float(f"{value:.5g}") for value in np.diag(body.moment_inertia))
        manifest = read_json(folder / "meta.json") if (folder / "meta.json").exists() else {}
        manifest[piece] = {"mass": mass, "inertia_diag": [x, y, z]}
        write_json(folder / "meta.json", manifest)
        (folder / "LICENSE.txt").write_text(NOTICE, encoding="utf-8")

    def verify(self, folder: Path) -> str:
        manifest = read_json(folder / "meta.json")
        for name in RECIPES:
            there = all((folder / f"{name}{kind}.obj").is_file() for kind in ("", "_vhacd"))
            if not there or name not in manifest:
                raise UserError(f"{folder} lacks {name}")
        return f"{len(RECIPES)} objects, as published in size and mass"


def _check_size(name: str, mesh: trimesh.Trimesh) -> None:
    sides, published = mesh.extents, RECIPES[name][1]
    missing = [side for side in published if not np.abs(sides - side).min() <= TOLERANCE]
    if missing or sides.max() > max(published) + OVERHANG:
        found, wanted = (" x ".join(f"{1e3 * side:.0f}" for side in sorted(size)) for size in (sides, published))
        raise UserError(
            f"{name} measures {found} mm, not about {wanted} mm as published: not the object that was meant"
        )


def _check_parts(name: str, mesh: trimesh.Trimesh, parts: list[trimesh.Trimesh]) -> None:
    if not all(part.is_watertight and part.volume > 0 for part in parts):
        raise UserError(f"{name}: a convex part is not closed")
    apart = np.abs(trimesh.util.concatenate(parts).bounds - mesh.bounds).max()
    if apart > 0.005 or sum(part.volume for part in parts) < 0.9 * meshes.closed(mesh).volume:
        raise UserError(f"{name}: its convex parts have not the shape of its surface")
