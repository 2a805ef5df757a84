"""Regions of the height map, candidates for one object each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from envs.segmentation.height_map import CELL, HeightMap, Mask

AROUND = np.ones((3, 3), np.bool_)  # eight neighbours
MINIMUM_AREA = 3e-4  # square metres; smaller things are noise (the smallest object covers 10e-4)
MINIMUM_PIXELS = 30  # of such a region
SLIVER_GAP = 2  # cells, at most, between a part and the object it belongs to
NECK = 3  # cells, largest erosion in the test whether a region separates
PART_AREA = 15e-4  # square metres; a smaller region beside a larger one is its handle or its rim
NARROW = 0.5  # of a part's own half width: a wider neck belongs to the object
GAP_AREA = 1e-4  # square metres; smaller holes are lost measurements
CORE_AREA = 2.5e-4  # square metres of a part that must remain
HOLLOW_AREA = 7e-4  # square metres; the hollow of a vessel is larger, the eye of a handle smaller


def box_around(region: Mask, margin: int) -> tuple[slice, slice]:
    """The rectangle of cells around a region that is not empty, `margin` cells wider if the map goes on so far."""
    rows, columns = (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
    row, column = (slice(max(0, int(side[0]) - margin), int(side[-1]) + 1 + margin) for side in (rows, columns))
    return row, column


def find_regions(heights: HeightMap) -> list[Mask]:
    """Connected regions [I, J] large enough to be objects; single empty cells do not separate them.

    A sliver beside a larger region belongs to it: missing measurements at an edge, of a handle for example, separate
    them.
    """
    closed = ndimage.binary_closing(heights.occupied, AROUND) | heights.occupied
    labels, count = ndimage.label(closed, AROUND)
    areas = np.bincount(labels.ravel(), minlength=count + 1) * CELL**2
    pixels = np.bincount(labels[tuple(heights.cells.T)], minlength=count + 1)
    kept = (areas >= MINIMUM_AREA) & (pixels >= MINIMUM_PIXELS)
    kept[0] = False  # the table
    labels[~kept[labels]] = 0
    whole = kept & (areas >= PART_AREA)
    for sliver in np.flatnonzero(kept & ~whole):
        beside = labels[ndimage.binary_dilation(labels == sliver, AROUND, iterations=SLIVER_GAP)]
        beside = np.bincount(beside[whole[beside]], minlength=1)
        if beside.any():
            labels[labels == sliver] = beside.argmax()
            kept[sliver] = False
    return [labels == number for number in np.flatnonzero(kept)]


def split_at_necks(region: Mask) -> list[Mask]:
    """The parts into which a small erosion separates a region, or the region itself.

    This separates objects in contact at a corner or an edge. Hollow vessels are filled first, so that their rims stay
    whole; the eye of a handle is not filled, so that the handle vanishes and does not count as a part.
    """
    (box,) = ndimage.find_objects(region.astype(np.int8))
    own = region[box]
    holes = ndimage.binary_fill_holes(own) & ~own
    solid = np.pad(own | (holes & ~_large(holes, GAP_AREA)) | _large(holes, HOLLOW_AREA), 1)
    depth = ndimage.distance_transform_cdt(solid)
    for neck in range(1, NECK + 1):
        labels, count = ndimage.label(_large(depth > neck, CORE_AREA), AROUND)
        if count > 1:
            owner = nearest_owner([labels == 1 + part for part in range(count)])[1:-1, 1:-1]
            areas = np.bincount(owner[own], minlength=count) * CELL**2
            widths = ndimage.maximum(depth, labels, np.arange(1, count + 1))
            large = np.flatnonzero((areas >= PART_AREA) & (neck <= NARROW * widths))
            if len(large) > 1:
                owner = nearest_owner([labels == 1 + part for part in large])[1:-1, 1:-1]
                parts = np.zeros((len(large), *region.shape), np.bool_)
                for number in range(len(large)):
                    parts[number][box] = own & (owner == number)
                return list(parts)
    return [region]


def _large(mask: Mask, area: float) -> Mask:
    """A mask without its regions smaller than `area` square metres."""
    labels, count = ndimage.label(mask, AROUND)
    return (np.bincount(labels.ravel(), minlength=count + 1) * CELL**2 >= area)[labels] & mask


def nearest_owner(parts: list[Mask]) -> NDArray[np.intp]:
    """For every cell [I, J] the number of the nearest part."""
    numbers = np.full(parts[0].shape, -1)
    for number, part in enumerate(parts):
        numbers[part] = number
    nearest = ndimage.distance_transform_edt(numbers < 0, return_distances=False, return_indices=True)
    return numbers[tuple(nearest)]
