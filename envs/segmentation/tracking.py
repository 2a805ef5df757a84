"""Knowing objects again from one height map to the next.

Whatever still stands where it stood is the same object. What is left over on the map is matched with the objects that
no longer stand where they did. What touches nothing else is learnt anew, so that its shape is known when it does.
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
CORE = 0.25  # of an object's cells must be left without its edge, if its edge is not to be looked at
INVADED = 0.3  # at most, of the free cells around an object may be taken by others if it has not moved
INVADED_CELLS = 3  # how wide around it
SAME_HEIGHT = 0.008  # metres
TOUCHING = 3  # cells, at most, between objects that are explained together
ALONE = 2  # cells, at least, around an object whose shape is learnt


@dataclass(frozen=True)
class Track:
    """What an object looked like when it was last observed.

    Attributes:
        region: [I, J] its cells. heights: [I, J] the map of that time.
        shape: as it stood alone for the last time, where it was last.
    """

    region: Mask
    heights: NDArray[np.float32]
    shape: Shape


def begin_track(region: Mask, heights: HeightMap) -> Track:
    """A new object, whose region must not be empty."""
    return Track(region, heights.heights, shape_of(region, heights.filled))


def follow_tracks(tracks: Sequence[Track | None], heights: HeightMap) -> list[Track | None]:
    """Each track as the new map shows it; None for what is not observed, or has never been."""
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
    """What stands on the map, large enough to be an object, beside the cells `taken` by what stands still."""
    # Noise makes outlines flicker: a thin seam around what stands still belongs to it.
    seams = ndimage.binary_dilation(taken, AROUND)
    free = ndimage.binary_closing(heights.occupied & ~seams, AROUND) & ~seams
    labels, count = ndimage.label(free, AROUND)
    pieces = [labels == 1 + number for number in range(count)]
    return [piece for piece in pieces if piece.sum() * CELL**2 >= MINIMUM_AREA]


def _with_seams(regions: dict[int, Mask], heights: HeightMap) -> dict[int, Mask]:
    """The same regions with the seams and specks that touch them, without those that are empty."""
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
    # A cell without a measurement now and then says nothing.
    same = (np.abs(before - now) < SAME_HEIGHT).sum() >= STILL * (before > 0.0).sum()
    around = ndimage.binary_dilation(region, AROUND, iterations=INVADED_CELLS) & (former == 0.0)
    around &= ~ndimage.binary_dilation(region, AROUND)
    return bool(same and (latest[around] > 0.0).sum() <= INVADED * around.sum())
