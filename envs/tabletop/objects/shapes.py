"""The ten builtin objects, the paper's YCB subset rebuilt at published sizes and masses, and a hundred random ones.

A shape is a tuple of convex parts; the same parts serve for collision and for the camera. Round
objects are prisms whose corners lie on the published circle.
Sizes and masses: YCB Object and Model Set (Calli et al. 2015). Random objects for training: a model trained on a few
objects only learns those, while random unions of shapes generalise to real ones (Tobin et al. 2018, "Domain
Randomization and Generative Models for Robotic Grasping", whose recipe this follows).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

SIDES = 16  # flat faces around a can; the largest gap to the circle is 2 % of its radius
STAVES = 10  # flat faces around a hollow vessel, each of them a convex part, which costs time in every step
WALL = 0.004  # metres; thickness of the mug's and the cup's wall and floor


@dataclass(frozen=True)
class Shape:
    """A rigid object made of convex parts, its origin at the centre of volume.

    Attributes:
        name: the YCB object's name, or prefix and name.
        parts: convex meshes in metres, z up in the object's usual pose.
        mass: kilograms.
    """

    name: str
    parts: tuple[trimesh.Trimesh, ...]
    mass: float

    @property
    def radius(self) -> float:
        """Metres from the origin to the farthest vertex."""
        return float(max(np.linalg.norm(part.vertices, axis=1).max() for part in self.parts))


def _box(x: float, y: float, z: float) -> list[trimesh.Trimesh]:
    return [trimesh.creation.box((x, y, z))]


def _cylinder(diameter: float, height: float) -> list[trimesh.Trimesh]:
    return [trimesh.creation.cylinder(radius=diameter / 2, height=height, sections=SIDES)]


def _hull(points: NDArray[np.float64] | list[list[float]]) -> trimesh.Trimesh:
    return trimesh.convex.convex_hull(np.asarray(points, dtype=np.float64))


def _ring(radius: float, z: float, angles: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full_like(angles, z)], axis=1)


def _lathed(bottom: float, top: float, height: float) -> list[trimesh.Trimesh]:
    """A hollow vessel open at the top (diameters in metres): a floor, and a wall with one convex stave per side.

    The staves end on the floor instead of beside it, so that only the floor touches the table: each part
    that touches adds contacts to solve.
    """
    turns = np.linspace(0.0, 2.0 * np.pi, STAVES + 1)
    floor = _hull(np.vstack([_ring(bottom / 2, z, turns[:-1]) for z in (0.0, WALL)]))
    staves = []
    for side in range(STAVES):
        edges = turns[side : side + 2]
        rings = [_ring(bottom / 2, WALL, edges), _ring(bottom / 2 - WALL, WALL, edges)]
        rings += [_ring(top / 2, height, edges), _ring(top / 2 - WALL, height, edges)]
        staves.append(_hull(np.vstack(rings)))
    return [floor, *staves]


def _mug(diameter: float, height: float) -> list[trimesh.Trimesh]:
    """A straight vessel with a three-part handle that stands 3 cm off the wall."""
    grip, reach = 0.012, 0.030  # metres
    handle = []
    for size, center in (
        ((reach, grip, grip), (diameter / 2 + reach / 2, 0.0, 0.75 * height)),
        ((reach, grip, grip), (diameter / 2 + reach / 2, 0.0, 0.25 * height)),
        ((grip, grip, height / 2 + grip), (diameter / 2 + reach, 0.0, height / 2)),
    ):
        part = trimesh.creation.box(size)
        part.apply_translation(center)
        handle.append(part)
    return [*_lathed(diameter, diameter, height), *handle]


def _banana(thickness: float, length: float) -> list[trimesh.Trimesh]:
    """A tapered tube bent by 100 degrees, lying flat; each part is the hull of two neighbouring sections."""
    bend, cuts = np.radians(100.0), 7
    tip = 0.4 * thickness / 2  # metres; radius of the tube at its ends
    bow = length / (2.0 * np.sin(bend / 2)) - tip  # metres; the outer corners of the ends are `length` apart
    around = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    sections = []
    for angle in np.linspace(-bend / 2, bend / 2, cuts):
        radius = thickness / 2 - (thickness / 2 - tip) * (abs(angle) / (bend / 2)) ** 3
        distance = bow + radius * np.cos(around)
        sections.append(
            np.stack([distance * np.sin(angle), distance * np.cos(angle) - bow, radius * np.sin(around)], axis=1)
        )
    return [_hull(np.vstack(pair)) for pair in pairwise(sections)]


# How each is made of its published sides (or diameters, then height), metres; and its published mass, kilograms.
RECIPES: dict[str, tuple[Callable[..., list[trimesh.Trimesh]], tuple[float, ...], float]] = {
    "sugar_box": (_box, (0.038, 0.089, 0.175), 0.514),
    "tomato_soup_can": (_cylinder, (0.066, 0.101), 0.349),
    "tuna_fish_can": (_cylinder, (0.085, 0.033), 0.171),
    "pudding_box": (_box, (0.110, 0.089, 0.035), 0.187),
    "gelatin_box": (_box, (0.085, 0.073, 0.028), 0.097),
    "potted_meat_can": (_box, (0.050, 0.097, 0.082), 0.370),
    "banana": (_banana, (0.036, 0.190), 0.066),
    "mug": (_mug, (0.080, 0.082), 0.118),
    "a_cups": (_lathed, (0.045, 0.055, 0.060), 0.013),
    "rubiks_cube": (_box, (0.057, 0.057, 0.057), 0.094),
}
BUILTIN_NAMES = tuple(RECIPES)


@cache
def builtin_shape(name: str) -> Shape:
    """Build the shape of a name in `BUILTIN_NAMES`."""
    build, size, mass = RECIPES[name]
    return shape_of(name, build(*size), mass)


def shape_of(name: str, parts: Sequence[trimesh.Trimesh], mass: float) -> Shape:
    """Convex parts (metres) as one object, moved so that their common centre of volume is the origin."""
    volumes = np.array([part.volume for part in parts])
    centroid = (volumes[:, None] * np.array([part.center_mass for part in parts])).sum(axis=0) / volumes.sum()
    for part in parts:
        part.apply_translation(-centroid)
    return Shape(name, tuple(parts), mass)


def plain_name(name: str) -> str:
    """An object's name without its set's: `mug` for `ycb/mug`."""
    return name.rpartition("/")[2]


def write_mesh(shape: Shape, folder: Path) -> Path:
    """Write the shape as one Wavefront file, a group per convex part, and return its path.

    Triangles do not share corners, so that a renderer shades them flat. An existing file is kept.
    """
    path = folder / f"{plain_name(shape.name)}.obj"
    if not path.exists():
        parts = [part.copy() for part in shape.parts]
        for part in parts:
            part.unmerge_vertices()
        trimesh.Scene(parts).export(path, include_normals=True)
    return path


RANDOM_NAMES = tuple(f"random/shape_{number:02d}" for number in range(100))
MAXIMUM_PARTS = 3
SIDE = (0.02, 0.16)  # metres, of a part
RADIUS = (0.035, 0.10)  # metres from the origin to the farthest vertex; the YCB objects used have 0.04 to 0.1
DENSITY = (150.0, 900.0)  # kilograms per cubic metre; a mug's and a box of sugar's, as solid bodies
CORNERS = 12  # points of a convex hull


@cache
def random_shape(name: str) -> Shape:
    """Build one of the hundred: one to three convex parts, each but the first with its middle on the one before.

    A name in `RANDOM_NAMES` gives the same object on every machine.
    """
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
