"""The simulator's own word on which pixel is whose."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from envs.segmentation.segmenter import Pixels
from envs.sensors.sensor import DepthImage

Truth = Callable[[], Sequence[NDArray[np.bool_]]]
"""The simulator's word: for each object, target first, where in the latest image [height, width] it is seen."""


class MaskSegmenter:
    """Passes on what the simulator says, of those pixels that have a measurement.

    Args:
        truth: asked once per image.
    """

    def __init__(self, truth: Truth) -> None:
        self._truth = truth

    def start(self, image: DepthImage, target: tuple[int, int] | None) -> list[Pixels]:
        """Begin an episode; the simulator needs no telling which object is the target."""
        return self.follow(image)

    def follow(self, image: DepthImage) -> list[Pixels]:
        """Pixels of each object, in the simulator's order."""
        measured = image.depth > 0.0
        found = []
        for mask in self._truth():
            rows, columns = np.nonzero(mask & measured)
            found.append((rows, columns))
        return found
