"""Ground-truth segmentation, from the simulator's masks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from envs.segmentation.segmenter import Pixels
from envs.sensors.sensor import DepthImage

TrueMasks = Callable[[], Sequence[NDArray[np.bool_]]]
"""Ground truth: for each object, target first, the pixels [height, width] that show it in the latest image."""


class MaskSegmenter:
    """The true mask of each object, restricted to pixels with a measurement.

    Args:
        true_masks: called once per image.
    """

    def __init__(self, true_masks: TrueMasks) -> None:
        self._true_masks = true_masks

    def start(self, image: DepthImage, target: tuple[int, int] | None) -> list[Pixels]:
        """Begin an episode; the simulator knows which object is the target."""
        return self.follow(image)

    def follow(self, image: DepthImage) -> list[Pixels]:
        """Pixels of each object, in the simulator's order."""
        measured = image.depth > 0.0
        found = []
        for mask in self._true_masks():
            rows, columns = np.nonzero(mask & measured)
            found.append((rows, columns))
        return found
