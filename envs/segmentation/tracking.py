"""Knowing objects again from one height map to the next.

Whatever still stands where it stood is the same object. What is left over on the map is matched with the objects that
no longer stand where they did, by how far they would have moved and how much they would have changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from envs.segmentation.height_map import CELL, HeightMap, Mask
from envs.segmentation.regions import AROUND, MINIMUM_AREA, box_around, nearest_owner
from envs.segmentation.registration import explain, fit
from envs.segmentation.shapes import Pose, Shape, shape_of

STILL = 0.85  # of an object's cells must show its former height if it has not moved
INVADED = 0.3  # at most, of the free cells around an object may be taken by others if it has not moved
INVADED_CELLS = 3  # how wide around it
SAME_HEIGHT = 0.008  # metres
FARTHEST = 0.5  # metres; no object goes farther between two images
REMNANT = 0.1  # of an object's former area; less is not the object but what another one left over
FRAGMENT, PENALTY = 0.4, 0.15  # a piece of less than this share is worth these metres less: a handle, say
SHARED = 0.3  # of its own area by which a piece must exceed another object's for an object to hide in it too
ALIKE = 0.65
ALONE = 2
RELEARN = 0.4
REACH = 0.03  # metres from a moved object's region within which a smaller one is taken for its other half


@dataclass(frozen=True)
class Track:
    """What an object looked like when it was last seen.

    Attributes:
        region: [I, J] its cells. heights: [I, J] the map of that time.
    """

    region: Mask
    heights: NDArray[np.float32]
    shape: Shape | None = None

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


def follow_tracks(tracks: Sequence[Track | None], heights: HeightMap) -> list[Track | None]:
    """Each track as the new map shows it; None for what is not seen, or has never been."""
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
    poses: dict[int, Pose] = {}
    concerned: set[int] = set()
    if moved and pieces:
        near = ndimage.binary_dilation(taken, AROUND, iterations=3)
        matched = None if any((piece & near).any() for piece in pieces) else _match_apart(moved, tracks, pieces, new)
        if matched is None:
            matched, poses = _match_together(moved, tracks, pieces, found, heights)
            concerned = set(matched)
        for number, region in matched.items():
            found[number] = region
    present = [number for number, region in enumerate(found) if region is not None]
    if present:  # seams and specks go to whom they touch
        regions = [found[number] for number in present]
        owner = nearest_owner(regions)  # type: ignore[arg-type]
        near = ndimage.binary_dilation(np.any(regions, axis=0), AROUND, iterations=2) & heights.occupied  # type: ignore[arg-type]
        for index, number in enumerate(present):
            found[number] = near & (owner == index)
    return _remembered(tracks, found, poses, concerned, new)


def _remembered(tracks, found, poses, concerned, new) -> list[Track | None]:
    """New tracks; the shape of an object that touches another stays the one that it had when it stood alone."""
    result: list[Track | None] = []
    for number, region in enumerate(found):
        if region is None or not region.any():
            result.append(None)
            continue
        others = np.any([other for n, other in enumerate(found) if n != number and other is not None] or [np.zeros_like(region)], axis=0)
        box = box_around(region, ALONE + 1)
        alone = not (ndimage.binary_dilation(region[box], AROUND, iterations=ALONE) & others[box]).any()
        track = tracks[number]
        if alone or (number in concerned and number not in poses):
            shape = shape_of(region, new)
        else:
            shape = replace(track.shape, pose=poses.get(number, track.shape.pose))
        result.append(Track(region, new, shape))
    return result


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


def _match_apart(moved, tracks, pieces, heights) -> dict[int, Mask] | None:
    """Moved objects among pieces that are one object each; None if some are not."""
    if len(pieces) != len(moved):
        return None
    known = {number: tracks[number] for number in moved}
    seen = [Track(piece, heights) for piece in pieces]
    cost = np.array([[_cost(track, piece) for piece in seen] for track in known.values()])
    chosen = {moved[row]: column for row, column in zip(*linear_sum_assignment(cost), strict=True)}
    for number, column in chosen.items():
        ratio = seen[column].area / known[number].area
        if ratio < REMNANT or (len(moved) > 1 and not ALIKE < ratio < 1.0 / ALIKE):
            return None
    return {number: pieces[column] for number, column in chosen.items()}


def _match_together(moved, tracks, pieces, found, heights):
    whole = ndimage.binary_closing(heights.occupied, AROUND) | heights.occupied
    labels, count = ndimage.label(whole, AROUND)
    touched = np.zeros(count + 1, np.bool_)
    for piece in pieces:
        touched[labels[piece]] = True
    touched[0] = False
    still = [n for n, region in enumerate(found) if region is not None and touched[labels[region]].any()]
    for number in still:
        touched[labels[found[number]]] = True
    touched[0] = False
    concerned = touched[labels] & heights.occupied
    # Still objects' cells that lie in components of which only a fringe belongs to them
    box = box_around(concerned, 0)
    origin = np.array([box[0].start, box[1].start])
    numbers = [*still, *moved]
    shapes = [tracks[n].shape.shifted(*(-origin).tolist()) for n in numbers]
    explained = explain(np.where(concerned, heights.heights, 0.0)[box], shapes, list(range(len(still))))
    owners = explained.owners()
    result, poses = {}, {}
    for index, number in enumerate(numbers):
        own = owners == index
        if own.sum() * CELL**2 >= MINIMUM_AREA:
            result[number] = np.zeros(heights.heights.shape, np.bool_)
            result[number][box] = own
            pose = explained.poses[index]
            if fit(explained, index) < RELEARN:
                continue
            poses[number] = replace(pose, row=pose.row + int(origin[0]), column=pose.column + int(origin[1]))
    # What no shape explains may be an object that shows another side now.
    absent = [n for n in moved if n not in result]
    if absent:
        left = concerned.copy()
        for region in result.values():
            left &= ~ndimage.binary_dilation(region, AROUND)
        labels, count = ndimage.label(left, AROUND)
        rest = [labels == 1 + number for number in range(count)]
        rest = [Track(piece, heights.heights) for piece in rest if piece.sum() * CELL**2 >= MINIMUM_AREA]
        if rest:
            cost = np.array([[_cost(tracks[n], piece) for piece in rest] for n in absent])
            for row, column in zip(*linear_sum_assignment(cost), strict=True):
                if rest[column].area >= SHARED * tracks[absent[row]].area:
                    result[absent[row]] = rest[column].region
    return result, poses


def _cost(track: Track, piece: Track) -> float:
    distance = float(np.linalg.norm(track.center - piece.center)) * CELL
    fragment = PENALTY if piece.area < FRAGMENT * track.area else 0.0
    return min(distance, FARTHEST) + fragment + float(np.abs(track.features() - piece.features()).sum())


