"""The appearance of bodies as triangles, for 3D viewers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from envs.physics import PhysicsWorld, Visual


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


def parts_of(world: PhysicsWorld) -> list[Part]:
    """Every shape in the world; `PhysicsWorld.link_poses` has the current pose of its frame.

    Raises:
        ValueError: a mesh file that the simulator has read cannot be read as triangles.
    """
    return [_part(visual) for visual in world.visuals()]


def _part(visual: Visual) -> Part:
    mesh = _mesh(visual)
    vertices = Rotation.from_quat(visual.orientation).apply(mesh.vertices) + np.array(visual.position)
    return Part(visual.body, visual.link, vertices, np.asarray(mesh.faces, dtype=np.int64), visual.color)


def _mesh(visual: Visual) -> trimesh.Trimesh:
    sizes = visual.sizes
    if visual.kind == "box":
        return trimesh.creation.box(sizes)
    if visual.kind == "cylinder":
        return trimesh.creation.cylinder(radius=sizes[1], height=sizes[0])
    if visual.kind == "capsule":
        # Both Bullet's and this one are centred on their middle.
        return trimesh.creation.capsule(radius=sizes[1], height=sizes[0])
    if visual.kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=2, radius=sizes[0])
    mesh = trimesh.load(visual.mesh, force="mesh")
    if not isinstance(mesh, trimesh.Trimesh):
        raise ValueError(f"{visual.mesh} holds no triangles")
    mesh.apply_scale(sizes)
    return mesh
