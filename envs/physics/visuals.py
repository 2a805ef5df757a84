"""Visual shapes and poses of bodies, for other renderers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from envs.physics.bullet import BulletClient, pybullet

KINDS = {
    pybullet.GEOM_MESH: "mesh",
    pybullet.GEOM_BOX: "box",
    pybullet.GEOM_CYLINDER: "cylinder",
    pybullet.GEOM_SPHERE: "sphere",
    pybullet.GEOM_CAPSULE: "capsule",
}


@dataclass(frozen=True)
class Poses:
    """True poses of bodies.

    Attributes:
        positions: [M, 3] metres. orientations: [M, 4] unit quaternions (x, y, z, w).
    """

    positions: NDArray[np.float64]
    orientations: NDArray[np.float64]


@dataclass(frozen=True)
class Visual:
    """One visual shape of a body.

    Attributes:
        body, link: numbers; link -1 is the body's base. kind: mesh, box, cylinder, sphere or capsule.
        sizes: a mesh's factors on (x, y, z); a box's sides; a cylinder's or capsule's length and radius; a sphere's
            radius; metres. mesh: the file, of a mesh only.
        position: [3] metres and orientation: [4] unit quaternion (x, y, z, w), in the link's frame.
        color: red, green, blue, opacity in [0, 1].
    """

    body: int
    link: int
    kind: str
    sizes: tuple[float, ...]
    mesh: Path | None
    position: tuple[float, ...]
    orientation: tuple[float, ...]
    color: tuple[float, ...]


def visuals(bullet: BulletClient) -> list[Visual]:
    """The visual shapes of every body in the world."""
    shapes = [
        shape
        for index in range(bullet.getNumBodies())
        for shape in bullet.getVisualShapeData(bullet.getBodyUniqueId(index))
    ]
    return [
        Visual(body, link, KINDS[kind], sizes, Path(os.fsdecode(mesh)) if mesh else None, position, orientation, color)
        for body, link, kind, sizes, mesh, position, orientation, color in (shape[:8] for shape in shapes)
        if kind in KINDS
    ]


def link_poses(bullet: BulletClient, links: Sequence[tuple[int, int]]) -> Poses:
    """True poses of the visuals' frames, for (body, link) pairs; link -1 is a body's base."""
    found = []
    for body, link in links:
        if link >= 0:
            found.append(bullet.getLinkState(body, link, computeForwardKinematics=1)[4:6])
            continue
        # Bullet returns the pose of the base's centre of mass.
        inertial = bullet.invertTransform(*bullet.getDynamicsInfo(body, -1)[3:5])
        found.append(bullet.multiplyTransforms(*bullet.getBasePositionAndOrientation(body), *inertial))
    return Poses(np.array([pose[0] for pose in found]), np.array([pose[1] for pose in found]))
