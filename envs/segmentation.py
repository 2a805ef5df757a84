"""From an image to the pixels of each object. For now the simulator's own mask tells which pixel is whose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from envs.physics import Rendering

Pixels = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Rows and columns of an object's pixels, each [P]."""


def segment_by_mask(rendering: Rendering, bodies: Sequence[int]) -> list[Pixels]:
    """Pixels of each body, in the order given; empty for a body that the camera does not see."""
    found = []
    for body in bodies:
        rows, columns = np.nonzero(rendering.bodies == body)
        found.append((rows, columns))
    return found
