"""Knowing objects again from one height map to the next.

Whatever still stands where it stood is the same object. What is left over on the map is matched with the objects that
no longer stand where they did, by how far they would have moved and how much they would have changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from envs.segmentation.height_map import CELL, HeightMap, Mask
from envs.segmentation.regions import AROUND, MINIMUM_AREA, box_around, nearest_owner
from envs.segmentation.splitting import HEIGHT_WEIGHT, Points, split_by_shapes

STILL = 0.85  # of an object's cells must show its former height if it has not moved
INVADED = 0.3  # at most, of the free cells around an object may be taken by others if it has not moved
INVADED_CELLS = 3  # how wide around it
SAME_HEIGHT = 0.008  # metres
FARTHEST = 0.5  # metres; no object goes farther between two images
REMNANT = 0.1  # of an object's former area; less is not the object but what another one left over
FRAGMENT, PENALTY = 0.4, 0.15  # a piece of less than this share is worth these metres less: a handle, say
SHARED = 0.3  # of its own area by which a piece must exceed another object's for an object to hide in it too
REACH = 0.03  # metres from a moved object's region within which a smaller one is taken for its other half


@dataclass(frozen=True)
class Track:
    """What an object looked like when it was last seen.

    Attributes:
        region: [I, J] its cells. heights: [I, J] the map of that time.
    """

    region: Mask
    heights: NDArray[np.float32]

    @property
    def points(self) -> Points:
        """Its cells as points, as `split_by_shapes` wants them, [C, 3]."""
        return as_points(self.region, self.heights)

    @property
    def center(self) -> NDArray[np.float64]:
        """Planar centre [2] in cells."""
        return np.argwhere(self.region).mean(axis=0)

    @property
    def area(self) -> int:
        """In cells."""
        return int(self.region.sum())

    def features(self) -> NDArray[np.float64]:
        """What stays alike as an object moves [2]: the root of its area, and its height; metres."""
        high = np.percentile(self.heights[self.region], 90)
        return np.array([np.sqrt(self.region.sum()) * CELL, float(high)])


def as_points(region: Mask, heights: NDArray[np.float32]) -> Points:
    """Cells of a region as points (x, y, `HEIGHT_WEIGHT` times the height) [C, 3], metres."""
    cells = np.argwhere(region)
    return np.column_stack((cells * CELL, HEIGHT_WEIGHT * heights[region]))


def follow_tracks(tracks: Sequence[Track | None], heights: HeightMap) -> list[Mask | None]:
    """For each track its region on the new map; None for what is not seen, or has never been."""
    new = heights.heights
    found: list[Mask | None] = [None] * len(tracks)
    taken = np.zeros(new.shape, np.bool_)
    for number, track in enumerate(tracks):
        if track is not None and _stands_still(track, new):
            found[number] = track.region & heights.occupied
            taken |= track.region
    moved = [number for number, track in enumerate(tracks) if track is not None and found[number] is None]
    # Noise makes outlines flicker: a thin seam around what stands still belongs to it.
    seams = ndimage.binary_dilation(taken, AROUND)
    free = ndimage.binary_closing(heights.occupied & ~seams, AROUND) & ~seams
    labels, count = ndimage.label(free, AROUND)
    pieces = [labels == 1 + number for number in range(count)]
    pieces = [piece for piece in pieces if piece.sum() * CELL**2 >= MINIMUM_AREA]
    for number, region in _match(moved, tracks, pieces, new).items():
        found[number] = region
    present = [number for number, region in enumerate(found) if region is not None]
    if present:  # seams and specks go to whom they touch
        regions = [found[number] for number in present]
        owner = nearest_owner(regions)  # type: ignore[arg-type]
        near = ndimage.binary_dilation(np.any(regions, axis=0), AROUND, iterations=2) & heights.occupied  # type: ignore[arg-type]
        for index, number in enumerate(present):
            found[number] = near & (owner == index)
    return found


def _stands_still(track: Track, heights: NDArray[np.float32]) -> bool:
    """Whether the object shows its former heights, and most of the free cells around it are still free.

    The second is for objects of one height that are pushed in a row: each then stands where the next one stood.
    """
    box = box_around(track.region, INVADED_CELLS + 1)
    region, former, latest = track.region[box], track.heights[box], heights[box]
    core = ndimage.binary_erosion(region, AROUND)
    core = core if core.any() else region
    before, now = former[core], latest[core]
    # A cell without a measurement now and then says nothing.
    same = (np.abs(before - now) < SAME_HEIGHT).sum() >= STILL * (before > 0.0).sum()
    around = ndimage.binary_dilation(region, AROUND, iterations=INVADED_CELLS) & (former == 0.0)
    around &= ~ndimage.binary_dilation(region, AROUND)
    return bool(same and (latest[around] > 0.0).sum() <= INVADED * around.sum())


def _match(
    moved: list[int], tracks: Sequence[Track | None], pieces: list[Mask], heights: NDArray[np.float32]
) -> dict[int, Mask]:
    """Regions of the moved objects among the pieces that nobody else has claimed."""
    known = {number: track for number in moved if (track := tracks[number]) is not None}
    if not known or not pieces:
        return {}
    seen = [Track(piece, heights) for piece in pieces]
    cost = np.array([[_cost(track, piece) for piece in seen] for track in known.values()])
    chosen = {list(known)[row]: column for row, column in zip(*linear_sum_assignment(cost), strict=True)}
    chosen = {n: column for n, column in chosen.items() if seen[column].area >= REMNANT * known[n].area}
    groups: dict[int, list[int]] = {column: [number] for number, column in chosen.items()}
    for number in known:
        if number not in chosen:  # fewer pieces than objects: it must be in contact with another
            if not groups:
                break
            column = min(groups, key=cost[list(known).index(number)].__getitem__)
            others = sum(known[other].area for other in groups[column])
            if seen[column].area >= others + SHARED * known[number].area:  # if not, it has left the table
                groups[column].append(number)
    found: dict[int, Mask] = {}
    for column, numbers in groups.items():
        found |= _divide(pieces[column], {number: known[number] for number in numbers}, heights)
    for column, piece in enumerate(pieces):  # more pieces than objects: parts of what is partly hidden
        if column not in groups and found:
            distance = {n: ndimage.distance_transform_cdt(~region)[piece].min() for n, region in found.items()}
            nearest = min(distance, key=distance.__getitem__)
            if distance[nearest] * CELL <= REACH:
                found[nearest] = found[nearest] | piece
    return found


def _cost(track: Track, piece: Track) -> float:
    distance = float(np.linalg.norm(track.center - piece.center)) * CELL
    fragment = PENALTY if piece.area < FRAGMENT * track.area else 0.0
    return min(distance, FARTHEST) + fragment + float(np.abs(track.features() - piece.features()).sum())


def _divide(piece: Mask, tracks: dict[int, Track], heights: NDArray[np.float32]) -> dict[int, Mask]:
    """Divide one piece among the objects that it must be."""
    numbers = list(tracks)
    if len(numbers) == 1:
        return {numbers[0]: piece}
    points = as_points(piece, heights)
    split = split_by_shapes(points, [track.points for track in tracks.values()])
    cells = np.argwhere(piece)
    found = {}
    for index, number in enumerate(numbers):
        own = cells[split.owners == index]
        if len(own) * CELL**2 >= MINIMUM_AREA:
            found[number] = np.zeros_like(piece)
            found[number][tuple(own.T)] = True
    return found
