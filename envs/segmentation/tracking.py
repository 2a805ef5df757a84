"""Tracking of objects from one height map to the next.

An unchanged region is the same object. The remaining regions are matched with the objects that moved. An object that
touches nothing gets a new shape, for later images in which it is in contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from envs.segmentation.height_map import CELL, HeightMap, Mask
from envs.segmentation.matching import Match, match_apart, match_together
from envs.segmentation.regions import AROUND, MINIMUM_AREA, box_around, nearest_owner
from envs.segmentation.shapes import Shape, shape_of

STILL = 0.85  # of an object's cells must show its former height if it has not moved
CORE = 0.25  # of an object's cells, least interior for a comparison without its edge
INVADED = 0.3  # at most, of the free cells around an object may be taken by others if it has not moved
INVADED_CELLS = 3  # cells around an object, width of that test
SAME_HEIGHT = 0.008  # metres
TOUCHING = 3  # cells, at most, between objects to register jointly
ALONE = 2  # free cells, at least, around an object whose shape is stored


@dataclass(frozen=True)
class Track:
    """The last observation of an object.

    Attributes:
        region: [I, J] its cells. heights: [I, J] the map of that time.
        shape: from when it last stood alone, at its last pose.
    """

    region: Mask
    heights: NDArray[np.float32]
    shape: Shape


def begin_track(region: Mask, heights: HeightMap) -> Track:
    """A new object, whose region must not be empty."""
    return Track(region, heights.heights, shape_of(region, heights.filled))


def follow_tracks(tracks: Sequence[Track | None], heights: HeightMap) -> list[Track | None]:
    """Update each track with the new map; None for objects that are occluded, or were never observed."""
    known = {number: track for number, track in enumerate(tracks) if track is not None}
    standing = {
        number: Match(track.region & heights.occupied, track.shape)
        for number, track in known.items()
        if _stands_still(track, heights.heights)
    }
    moved = {number: track.shape for number, track in known.items() if number not in standing}
    taken = np.any([known[number].region for number in standing] or [np.zeros_like(heights.occupied)], axis=0)
    pieces = _pieces(taken, heights)
    found = standing
    if moved and pieces:
        near = ndimage.binary_dilation(taken, AROUND, iterations=TOUCHING)
        apart = None if (near & np.any(pieces, axis=0)).any() else match_apart(moved, pieces, heights)
        found = standing | (match_together(moved, standing, pieces, heights) if apart is None else apart)
    regions = _with_seams({number: match.region for number, match in found.items()}, heights)
    return [
        _remembered(number, regions, found[number].shape, heights) if number in regions else None
        for number in range(len(tracks))
    ]


def _pieces(taken: Mask, heights: HeightMap) -> list[Mask]:
    """Regions of the map large enough for an object, outside of the cells `taken` by unmoved objects."""
    # Noise makes outlines flicker: a thin seam around an unmoved object belongs to it.
    seams = ndimage.binary_dilation(taken, AROUND)
    free = ndimage.binary_closing(heights.occupied & ~seams, AROUND) & ~seams
    labels, count = ndimage.label(free, AROUND)
    pieces = [labels == 1 + number for number in range(count)]
    return [piece for piece in pieces if piece.sum() * CELL**2 >= MINIMUM_AREA]


def _with_seams(regions: dict[int, Mask], heights: HeightMap) -> dict[int, Mask]:
    """The same regions with the seams and specks that touch them, without empty ones."""
    if not regions:
        return {}
    masks = list(regions.values())
    owner = nearest_owner(masks)
    near = ndimage.binary_dilation(np.any(masks, axis=0), AROUND, iterations=2) & heights.occupied
    grown = {number: near & (owner == index) for index, number in enumerate(regions)}
    return {number: region for number, region in grown.items() if region.any()}


def _remembered(number: int, regions: dict[int, Mask], shape: Shape | None, heights: HeightMap) -> Track:
    """An object's new track, with its former shape if it has one and touches another object now."""
    region = regions[number]
    box = box_around(region, ALONE + 1)
    around = ndimage.binary_dilation(region[box], AROUND, iterations=ALONE)
    alone = not any((around & other[box]).any() for one, other in regions.items() if one != number)
    return begin_track(region, heights) if alone or shape is None else Track(region, heights.heights, shape)


def _stands_still(track: Track, heights: NDArray[np.float32]) -> bool:
    """Whether the object shows its former heights, and most of the free cells around it are still free.

    The second is for objects of one height that are pushed in a row: each then stands where the next one stood.
    """
    box = box_around(track.region, INVADED_CELLS + 1)
    region, former, latest = track.region[box], track.heights[box], heights[box]
    core = ndimage.binary_erosion(region, AROUND)
    measured = former > 0.0
    core = core if (core & measured).sum() >= CORE * (region & measured).sum() else region
    before, now = former[core], latest[core]
    # Single cells without a measurement do not count.
    same = (np.abs(before - now) < SAME_HEIGHT).sum() >= STILL * (before > 0.0).sum()
    around = ndimage.binary_dilation(region, AROUND, iterations=INVADED_CELLS) & (former == 0.0)
    around &= ~ndimage.binary_dilation(region, AROUND)
    return bool(same and (latest[around] > 0.0).sum() <= INVADED * around.sum())
