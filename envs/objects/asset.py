"""An object's description for the simulator, before its size and mass are sampled."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ObjectAsset:
    """An object of a set.

    Attributes:
        name: in its set. mass: kilograms, as published.
        radius: metres from the origin to the farthest vertex.
        collision: Wavefront file, a group per convex part. visual: Wavefront file for the camera. Both in
            metres, the origin at the centre of mass.
        inertia: (x, y, z) kilograms times square metres at that mass and size, about the file's axes; None: the
            simulator computes that of the bounding box.
    """

    name: str
    mass: float
    radius: float
    collision: Path
    visual: Path
    inertia: tuple[float, float, float] | None = None

    def inertia_of(self, mass: float, scale: float) -> tuple[float, float, float] | None:
        """The inertia at another mass (kilograms) and size (factor); it is proportional to mass times area."""
        if self.inertia is None:
            return None
        factor = mass / self.mass * scale**2
        x, y, z = (value * factor for value in self.inertia)
        return x, y, z


def plain_name(name: str) -> str:
    """An object's name without its set's: `mug` for `ycb/mug`."""
    return name.rpartition("/")[2]


def listed(names: Iterable[str]) -> str:
    """Names for a one-line message: all of them, or both ends of a long list."""
    every = list(names)
    return ", ".join(every if len(every) <= 40 else [*every[:2], "...", every[-1]])
