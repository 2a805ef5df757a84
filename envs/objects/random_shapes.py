"""A hundred random objects for training: unions of boxes, cylinders and hulls.

A model trained on a few objects only learns those. Grasping learned from random unions of shapes works on real objects
(Tobin et al. 2018, "Domain Randomization and Generative Models for Robotic Grasping", whose recipe this follows).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from envs.objects.asset import listed
from envs.objects.shapes import SIDES, Shape, shape_of

RANDOM = "random"  # prefix of the names of these objects
RANDOM_NAMES = tuple(f"{RANDOM}/shape_{number:02d}" for number in range(100))
MAXIMUM_PARTS = 3
SIDE = (0.02, 0.16)  # metres, of a part
RADIUS = (0.035, 0.10)  # metres from the origin to the farthest vertex; the YCB objects used have 0.04 to 0.1
DENSITY = (150.0, 900.0)  # kilograms per cubic metre; a mug's and a box of sugar's, as solid bodies
CORNERS = 12  # points of a convex hull


@cache
def random_shape(name: str) -> Shape:
    """Build one of the hundred: one to three convex parts, each but the first with its middle on the one before.

    The same name gives the same object on every machine.

    Raises:
        ValueError: the name is not one of `RANDOM_NAMES`.
    """
    if name not in RANDOM_NAMES:
        raise ValueError(f"unknown object {name!r}: choose from {listed(RANDOM_NAMES)}")
    generator = np.random.default_rng(RANDOM_NAMES.index(name))
    while True:
        parts = [_part(generator)]
        for _ in range(int(generator.integers(MAXIMUM_PARTS))):
            part, faces = _part(generator), parts[-1].triangles_center
            part.apply_translation(faces[generator.integers(len(faces))])
            parts.append(part)
        volume = sum(part.volume for part in parts)
        shape = shape_of(name, parts, mass=float(volume * _between(DENSITY, generator)))
        if RADIUS[0] <= shape.radius <= RADIUS[1]:
            return shape


def _part(generator: np.random.Generator) -> trimesh.Trimesh:
    """A convex mesh around the origin, in a random orientation."""
    sides = _between(SIDE, generator, size=3)
    kind = int(generator.integers(3))
    if kind == 0:
        part = trimesh.creation.box(sides)
    elif kind == 1:
        part = trimesh.creation.cylinder(radius=sides[0] / 2, height=sides[1], sections=SIDES)
    else:
        directions = generator.normal(size=(CORNERS, 3))
        part = trimesh.convex.convex_hull(directions / np.linalg.norm(directions, axis=1, keepdims=True) * sides / 2)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.random(random_state=generator).as_matrix()
    part.apply_transform(turn)
    return part


def _between(bounds: tuple[float, float], generator: np.random.Generator, size: int | None = None) -> Any:
    """Numbers whose logarithm is uniform."""
    return np.exp(generator.uniform(np.log(bounds[0]), np.log(bounds[1]), size))
