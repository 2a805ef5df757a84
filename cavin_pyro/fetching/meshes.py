"""From a scan to a body for the simulator: fewer faces, convex parts, mass and inertia."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from cavin_pyro.config.errors import UserError

HULL_FACES = 240  # of a convex part; the simulator's time grows with its corners
CONVEX = 0.8  # share of its hull that an object fills from which on the hull stands for it
LARGEST_PARTS = 16  # convex parts of one object
CONCAVITY = 0.05  # CoACD's threshold: how far, relative to the object, a part may be from convex
LEAK = 0.01  # share of its surface by which a mesh may fail to close and still have a volume


class MissingExtraError(UserError):
    """A package that only this command needs is not installed."""

    def __init__(self, what: str) -> None:
        super().__init__(f"{what} needs packages of its own: pip install 'cavin-pyro[assets]', then run again")


@dataclass(frozen=True)
class Solid:
    """Volume (cubic metres), centre [3] (metres) and inertia [3, 3] (square metres: per kilogram) of a body."""

    volume: float
    center: NDArray[np.float64]
    inertia: NDArray[np.float64]


def decimated(mesh: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """The mesh with at most so many faces."""
    if len(mesh.faces) <= faces:
        return mesh
    if importlib.util.find_spec("fast_simplification") is None:
        raise MissingExtraError("decimating a mesh")
    return mesh.simplify_quadric_decimation(face_count=faces)


def convex_parts(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Convex parts that together have the shape of the mesh: its hull, or what CoACD finds (Wei et al. 2022)."""
    if measured(mesh).volume >= CONVEX * mesh.convex_hull.volume:
        return [_simple_hull(mesh.convex_hull)]
    if importlib.util.find_spec("coacd") is None:
        raise MissingExtraError("taking a hollow object apart")
    import coacd

    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces), threshold=CONCAVITY, max_convex_hull=LARGEST_PARTS, seed=0
    )
    return [_simple_hull(trimesh.Trimesh(vertices, faces).convex_hull) for vertices, faces in parts]


def measured(mesh: trimesh.Trimesh) -> Solid:
    """Volume, centre of mass and inertia about it, of uniform density; scans have small holes, which count as closed.

    Raises:
        UserError: the surface is so open that it bounds no volume.
    """
    closed = mesh.copy()
    closed.merge_vertices()
    closed.fill_holes()
    trimesh.repair.fix_normals(closed)
    # Area vectors of a closed surface sum to zero.
    leak = np.linalg.norm((closed.face_normals * closed.area_faces[:, None]).sum(axis=0)) / closed.area
    if not leak < LEAK or not closed.volume > 0:
        raise UserError(
            f"a mesh of {len(mesh.faces)} faces is not closed: {100 * leak:.1f} % of its surface is missing"
        )
    return Solid(float(closed.volume), closed.center_mass, closed.moment_inertia / closed.volume)


def long_side_along_x(mesh: trimesh.Trimesh) -> None:
    """Turn the mesh about z until the smallest rectangle around its plan has its long side along x."""
    turn, extents = trimesh.bounds.oriented_bounds_2D(mesh.vertices[:, :2])
    angle = np.arctan2(turn[1, 0], turn[0, 0]) + (np.pi / 2 if extents[0] < extents[1] else 0.0)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(angle, (0.0, 0.0, 1.0)))


def write_parts(path: Path, parts: Sequence[trimesh.Trimesh]) -> None:
    """One Wavefront file, a group per part."""
    lines, offset = [], 1
    for number, part in enumerate(parts):
        lines.append(f"o part_{number}")
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in part.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in part.faces + offset]
        offset += len(part.vertices)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_parts(path: Path) -> list[trimesh.Trimesh]:
    """The parts of a file as `write_parts` writes it.

    Raises:
        UserError: the file is missing or damaged.
    """
    try:
        groups: list[tuple[list[list[float]], list[list[int]]]] = []
        for word, *rest in (line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()):
            if word == "o":
                groups.append(([], []))
            elif word == "v":
                groups[-1][0].append([float(value) for value in rest[:3]])
            elif word == "f":
                groups[-1][1].append([int(corner.partition("/")[0]) for corner in rest])
        parts, offset = [], 1
        for vertices, faces in groups:
            parts.append(trimesh.Trimesh(vertices, np.array(faces) - offset))
            offset += len(vertices)
    except (OSError, ValueError, IndexError) as error:
        raise UserError(f"{path} is missing or damaged") from error
    if not parts or not all(len(part.faces) for part in parts):
        raise UserError(f"{path} is damaged: it holds no mesh")
    return parts


def _simple_hull(hull: trimesh.Trimesh) -> trimesh.Trimesh:
    return decimated(hull, HULL_FACES).convex_hull
