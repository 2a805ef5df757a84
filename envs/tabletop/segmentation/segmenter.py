"""The interface of segmentations: from depth images to the pixels of each object."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.sensors.sensor import DepthImage

Pixels = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Rows and columns of an object's pixels, each [P]."""


class Segmenter(Protocol):
    """Finds the objects in an episode's first image, and tracks them in later ones.

    The result has the pixels of one object per entry, at most M of them. An object keeps its place in the list
    throughout the episode; the first is the target. An object out of sight has no pixels.
    """

    def start(self, image: DepthImage, target: tuple[int, int] | None) -> list[Pixels]:
        """Begin an episode.

        `target`: row and column of a pixel on the target, which a person confirms once; None if the target is occluded,
        which leaves the first entry empty.
        """

    def follow(self, image: DepthImage) -> list[Pixels]:
        """Find the same objects in the episode's next image."""


TrueMasks = Callable[[], Sequence[NDArray[np.bool_]]]
"""Ground truth: for each object, target first, the pixels [height, width] that show it in the latest image."""


class MaskSegmenter:
    """The true mask of each object, restricted to pixels with a measurement.

    `true_masks`: called once per image.
    """

    def __init__(self, true_masks: TrueMasks) -> None:
        self._true_masks = true_masks

    def start(self, image: DepthImage, target: tuple[int, int] | None) -> list[Pixels]:
        return self.follow(image)

    def follow(self, image: DepthImage) -> list[Pixels]:
        measured = image.depth > 0.0
        found = (np.nonzero(mask & measured) for mask in self._true_masks())
        return [(rows, columns) for rows, columns in found]
