"""The appearance of bodies as triangles, for 3D viewers."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cavin_pyro.envs.tabletop.physics.bullet import BulletClient, pybullet


@dataclass(frozen=True)
class Part:
    """One rigid shape.

    Attributes:
        body, link: its numbers in the simulator; link -1 is the body's base.
        vertices: [V, 3] metres in the link's frame. triangles: [F, 3] numbers of vertices.
        color: red, green, blue, opacity in [0, 1].
    """

    body: int
    link: int
    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    color: tuple[float, ...]


def parts_of(bullet: BulletClient) -> list[Part]:
    """Every shape in a simulation.

    Raises:
        ValueError: a mesh file that the simulator has read cannot be read as triangles.
    """
    parts = []
    for index in range(bullet.getNumBodies()):
        for shape in bullet.getVisualShapeData(bullet.getBodyUniqueId(index)):
            body, link, kind, sizes, file, position, orientation, color = shape[:8]
            mesh = _mesh(kind, sizes, file)
            vertices = Rotation.from_quat(orientation).apply(mesh.vertices) + np.array(position)
            parts.append(Part(body, link, vertices, np.asarray(mesh.faces, dtype=np.int64), color))
    return parts


def _mesh(kind: int, sizes: tuple[float, ...], file: bytes) -> trimesh.Trimesh:
    """Triangles around the shape's own origin.

    Args:
        sizes: metres; a box's sides; a cylinder's or capsule's length and radius; a sphere's radius; of a mesh, the
            factors on (x, y, z) of its file.
    """
    if kind == pybullet.GEOM_BOX:
        return trimesh.creation.box(sizes)
    if kind == pybullet.GEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=sizes[1], height=sizes[0])
    if kind == pybullet.GEOM_CAPSULE:  # both Bullet's and this one are centred on their middle
        return trimesh.creation.capsule(radius=sizes[1], height=sizes[0])
    if kind == pybullet.GEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=2, radius=sizes[0])
    mesh = trimesh.load(os.fsdecode(file), force="mesh")
    if not isinstance(mesh, trimesh.Trimesh):
        raise ValueError(f"{os.fsdecode(file)} holds no triangles")
    mesh.apply_scale(sizes)
    return mesh
