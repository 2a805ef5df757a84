"""Sampling of objects: shapes, sizes, masses, friction and poses.

Source: paper section 4.1 and the published implementation (what is randomised per object).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_type_hints

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cavin_pyro.envs.tabletop.objects.object_sets import BUILTIN, ObjectAsset, ObjectSet, chosen
from cavin_pyro.envs.tabletop.objects.shapes import BUILTIN_NAMES
from cavin_pyro.envs.tabletop.workspace import TABLE_HIGH, TABLE_LOW
from cavin_pyro.envs.world import NoRoomError
from cavin_pyro.models.checks import check_kinds

LIMITS = {  # of ranges; what lies beyond is a slip, with which no scene comes to rest
    "scale": (0.1, 10.0),
    "mass": (0.001, 1000.0),
    "friction": (0.001, 10.0),
    "kilograms": (0.001, 1000.0),
}
ATTEMPTS = 400  # arrangements sampled before an area counts as too small


@dataclass(frozen=True)
class ObjectRanges:
    """Ranges from which object parameters are sampled, uniformly.

    Attributes:
        names: objects to choose from. scale: factor on size. mass: factor on the published mass.
        friction: Coulomb coefficient against the table.
        clearance: metres between neighbouring centres at the start.
        kilograms: mass of every object, instead of the factor.
        target: names for the first object, the target, instead of `names`.
        drop_height: metres above the table from which centres fall, at least; 0 means just above the table.

    Raises ValueError: a range beyond `LIMITS`.
    """

    names: tuple[str, ...] = BUILTIN_NAMES
    scale: tuple[float, float] = (0.8, 1.2)
    mass: tuple[float, float] = (0.5, 2.0)
    friction: tuple[float, float] = (0.5, 0.9)
    clearance: float = 0.15
    kilograms: tuple[float, float] | None = None
    target: tuple[str, ...] = ()
    drop_height: float = 0.0

    def __post_init__(self) -> None:
        check_kinds(vars(self), get_type_hints(type(self)))
        for name, (least, most) in LIMITS.items():
            if (given := getattr(self, name)) is not None:
                if len(given) != 2 or not least <= given[0] <= given[1] <= most:
                    said = f"ranges.{name} must be low and high, from {least:g} to {most:g}"
                    raise ValueError(f"{said}, not {list(given)}")
                object.__setattr__(self, name, tuple(given))


@dataclass(frozen=True)
class ObjectParameters:
    """One sampled object: its shape and parameters, and the pose from which it is dropped.

    `name`: in its set. `scale`: factor. `mass`: kilograms. `friction`: coefficient. `position`: (x, y, z) metres.
    `orientation`: unit quaternion (x, y, z, w).
    """

    name: str
    scale: float
    mass: float
    friction: float
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]


Area = Sequence[tuple[tuple[float, float], tuple[float, float]]]
"""A union of rectangles, each ((low x, low y), (high x, high y)) in metres."""

WHOLE_TABLE: Area = (((TABLE_LOW[0] + 0.1, TABLE_LOW[1] + 0.1), (TABLE_HIGH[0] - 0.1, TABLE_HIGH[1] - 0.1)),)


def arrange(areas: Sequence[Area], clearance: float, generator: np.random.Generator) -> NDArray[np.float64]:
    """Planar positions [M, 2] in metres, one in each area, no two closer than `clearance`.

    Raises NoRoomError: no arrangement was found.
    """
    for _ in range(ATTEMPTS):
        chosen: list[NDArray[np.float64]] = []
        for area in areas:
            points = [generator.uniform(*area[int(generator.integers(len(area)))]) for _ in range(20)]
            free = [one for one in points if all(np.linalg.norm(one - other) >= clearance for other in chosen)]
            if not free:
                break
            chosen.append(free[0])
        if len(chosen) == len(areas):
            return np.stack(chosen)
    raise NoRoomError(
        f"no room for {len(areas)} objects at least {clearance:g} m apart where the layout starts them: "
        "use fewer objects, more start tiles, or a smaller env.ranges.clearance"
    )


def sample_objects(
    areas: Sequence[Area], ranges: ObjectRanges, generator: np.random.Generator, objects: ObjectSet = BUILTIN
) -> list[ObjectParameters]:
    """Sample one object per area, in random orientation, above the table and clear of its neighbours.

    `areas`: start area of each object; the first is the target. `objects`: the set of the names. Raises NoRoomError:
    the areas are too small for so many objects. ValueError: an unknown name.
    """
    names = chosen(ranges.names, objects)
    targets = chosen(ranges.target, objects) or names
    positions = arrange(areas, ranges.clearance, generator)
    orientations = Rotation.random(len(areas), random_state=generator).as_quat()
    sampled: list[ObjectParameters] = []
    circles: list[tuple[NDArray[np.float64], float, float]] = []  # planar centre, radius, top
    for position, orientation in zip(positions, orientations, strict=True):
        choices = names if sampled else targets
        asset = objects.asset(choices[generator.integers(len(choices))])
        check_kinds({f"{type(objects).__name__}.asset": asset}, {f"{type(objects).__name__}.asset": ObjectAsset})
        scale = generator.uniform(*ranges.scale)
        radius = scale * asset.radius
        # Long neighbours may overlap in the plan view: the later one is then dropped from above the earlier one.
        below = [top for center, other, top in circles if np.linalg.norm(position - center) < radius + other]
        height = max(max([0.005, *(top + 0.005 for top in below)]) + radius, ranges.drop_height)
        circles.append((position, radius, height + radius))
        mass = generator.uniform(*(ranges.kilograms or ranges.mass))
        sampled.append(
            ObjectParameters(
                name=asset.name,
                scale=float(scale),
                mass=float(mass if ranges.kilograms else asset.mass * mass),
                friction=float(generator.uniform(*ranges.friction)),
                position=(float(position[0]), float(position[1]), float(height)),
                orientation=tuple(float(value) for value in orientation),  # type: ignore[arg-type]
            )
        )
    return sampled
