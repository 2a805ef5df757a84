"""From a scan to a body for the simulator: fewer faces, convex parts, mass and inertia."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from trimesh.exchange.obj import export_obj

from cavin_pyro.config.errors import UserError

HULL_FACES = 240  # of a convex part; the simulator's time grows with its corners
CONVEX = 0.8  # share of its hull that an object fills from which on the hull stands for it
LARGEST_PARTS = 16  # convex parts of one object
CONCAVITY = 0.05  # CoACD's threshold: how far, relative to the object, a part may be from convex
LEAK = 0.01  # share of its surface by which a mesh may fail to close and still have a volume


def decimated(mesh: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """The mesh with at most so many faces."""
    return mesh if len(mesh.faces) <= faces else mesh.simplify_quadric_decimation(face_count=faces)


def convex_parts(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Convex parts that together have the shape of the mesh: its hull, or what CoACD finds (Wei et al. 2022)."""
    if closed(mesh).volume >= CONVEX * mesh.convex_hull.volume:
        return [_simple_hull(mesh.convex_hull)]
    import coacd

    coacd.set_log_level("error")
    whole = coacd.Mesh(mesh.vertices, mesh.faces)
    parts = coacd.run_coacd(whole, threshold=CONCAVITY, max_convex_hull=LARGEST_PARTS, seed=0)
    return [_simple_hull(trimesh.Trimesh(vertices, faces).convex_hull) for vertices, faces in parts]


def closed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A copy without the small holes of a scan, which has a volume, a centre of mass and an inertia.

    A UserError: the surface is so open that it bounds no volume.
    """
    whole = mesh.copy()
    whole.merge_vertices()
    whole.fill_holes()
    trimesh.repair.fix_normals(whole)
    # Area vectors of a closed surface sum to zero.
    leak = np.linalg.norm((whole.face_normals * whole.area_faces[:, None]).sum(axis=0)) / whole.area
    if not leak < LEAK or not whole.volume > 0:
        raise UserError(
            f"a mesh of {len(mesh.faces)} faces is not closed: {100 * leak:.1f} % of its surface is missing"
        )
    return whole


def long_side_along_x(mesh: trimesh.Trimesh) -> None:
    """Turn the mesh about z until the smallest rectangle around its plan has its long side along x."""
    turn, extents = trimesh.bounds.oriented_bounds_2D(mesh.vertices[:, :2])
    angle = np.arctan2(turn[1, 0], turn[0, 0]) + (np.pi / 2 if extents[0] < extents[1] else 0.0)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(angle, (0.0, 0.0, 1.0)))


def write_parts(path: Path, parts: Sequence[trimesh.Trimesh]) -> None:
    """One Wavefront file, a group per part."""
    plain = {"include_normals": False, "include_color": False, "include_texture": False, "header": None}
    path.write_text(export_obj(trimesh.Scene(parts), digits=6, **plain), encoding="utf-8")


def read_mesh(content: bytes, kind: str, name: str) -> trimesh.Trimesh:
    """A mesh from a file of another kind, without colours and normals: corners at one place become one vertex."""
    try:
        mesh = trimesh.load_scene(io.BytesIO(content), file_type=kind).to_mesh()
        return trimesh.Trimesh(mesh.vertices, mesh.faces)
    except ImportError:
        raise
    except Exception as error:  # whatever a reader makes of bytes that are no mesh
        raise UserError(f"{name} holds no mesh that can be read ({type(error).__name__})") from error


def _simple_hull(hull: trimesh.Trimesh) -> trimesh.Trimesh:
    return decimated(hull, HULL_FACES).convex_hull
