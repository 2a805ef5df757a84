"""Objects found in the depth image alone, as on a real robot.

It fits and removes the table's plane, projects the rest onto a height map, finds its connected regions, splits objects
in contact, and tracks objects from image to image by position and shape. The set of objects is that of the first image:
later regions count as noise or as parts of these.

In later images, an unchanged region is the same object. The remaining regions are matched with the objects that moved:
pieces of the map, or parts of a piece of several objects. An object that touches nothing gets a new shape, for later
images in which it is in contact.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from cavin_pyro.envs.tabletop.segmentation.height_map import (
    AROUND,
    CELL,
    MINIMUM_AREA,
    HeightMap,
    Mask,
    box_around,
    cells_of,
    find_regions,
    map_heights,
    nearest_owner,
    split_at_necks,
)
from cavin_pyro.envs.tabletop.segmentation.registration import Shape, explain, shape_of
from cavin_pyro.envs.tabletop.segmentation.segmenter import Pixels
from cavin_pyro.envs.tabletop.sensors.sensor import DepthImage
from cavin_pyro.envs.tabletop.workspace import OBJECT_SLOTS

FARTHEST = 0.5  # metres; no object goes farther between two images
REMNANT = 0.1  # of an object's former area; smaller pieces are remnants of another object
FRAGMENT, PENALTY = 0.4, 0.15  # a smaller piece costs these extra metres: a handle, for example
SIMILAR = 0.65  # ratio of the areas of an object and of its piece, at least, where several objects have moved
LEFT_OVER = 0.3  # of an object's area, at least, for an object that no shape explains
RECOGNISED = 0.4  # of a shape's cells; below it, the object shows another side and gets a new shape


@dataclass(frozen=True)
class Match:
    """An object's cells [I, J], and its former shape at its new pose, None if it does not fit."""

    region: Mask
    shape: Shape | None


def match_apart(moved: Mapping[int, Shape], pieces: Sequence[Mask], heights: HeightMap) -> dict[int, Match] | None:
    """The piece of each moved object by its number; None unless every piece is one object."""
    if len(pieces) != len(moved):
        return None
    observed = [shape_of(piece, heights.filled) for piece in pieces]
    chosen = _assign(list(moved.values()), observed)
    for shape, column in zip(moved.values(), chosen, strict=True):
        ratio = observed[column].area / shape.area
        if ratio < REMNANT or (len(moved) > 1 and not SIMILAR < ratio < 1.0 / SIMILAR):
            return None
    return {number: Match(pieces[column], None) for number, column in zip(moved, chosen, strict=True)}


def match_together(
    moved: Mapping[int, Shape], standing: Mapping[int, Match], pieces: Sequence[Mask], heights: HeightMap
) -> dict[int, Match]:
    """The regions of moved objects among the pieces, and of those still standing that touch these pieces."""
    labels, count = ndimage.label(ndimage.binary_closing(heights.occupied, AROUND) | heights.occupied, AROUND)
    touched = np.zeros(count + 1, np.bool_)
    for piece in pieces:
        touched[labels[piece]] = True
    touched[0] = False  # the table
    shapes = {n: one.shape for n, one in standing.items() if one.shape and touched[labels[one.region]].any()}
    still = range(len(shapes))
    for number in shapes:
        touched[labels[standing[number].region]] = True
    touched[0] = False
    shapes |= moved
    concerned = touched[labels] & (heights.filled > 0.0)
    box = box_around(concerned, 0)
    row, column = box[0].start, box[1].start
    arrangement = explain(
        np.where(concerned, heights.filled, 0.0)[box], [one.shifted(-row, -column) for one in shapes.values()], still
    )
    owners = np.full(concerned.shape, -1)
    owners[box] = arrangement.owners()
    found: dict[int, Match] = {}
    for index, (number, shape) in enumerate(shapes.items()):
        region = owners == index
        if region.sum() * CELL**2 >= MINIMUM_AREA:
            fits = arrangement.saved(index) >= RECOGNISED * shape.area
            placed = replace(shape, pose=arrangement.poses[index]).shifted(row, column) if fits else None
            found[number] = Match(region, placed)
    return found | _left_over({n: shape for n, shape in moved.items() if n not in found}, found, concerned, heights)


def _left_over(
    absent: Mapping[int, Shape], found: Mapping[int, Match], concerned: Mask, heights: HeightMap
) -> dict[int, Match]:
    """Objects among the `concerned` cells [I, J] that no shape explains: such an object shows another side."""
    if not absent:
        return {}
    explained = np.any([one.region for one in found.values()] or [np.zeros_like(concerned)], axis=0)
    pieces = _connected(concerned & ~ndimage.binary_dilation(explained, AROUND))
    observed = [shape_of(piece, heights.filled) for piece in pieces]
    matched = zip(absent.items(), _assign(list(absent.values()), observed), strict=True)
    return {
        number: Match(pieces[column], None)
        for (number, shape), column in matched
        if column >= 0 and observed[column].area >= LEFT_OVER * shape.area
    }


def _assign(shapes: Sequence[Shape], observed: Sequence[Shape]) -> list[int]:
    """For each shape the number of the most probable observed object, -1 for none."""
    chosen = [-1] * len(shapes)
    if observed:
        cost = np.array([[_cost(shape, piece) for piece in observed] for shape in shapes])
        for row, column in zip(*linear_sum_assignment(cost), strict=True):
            chosen[row] = int(column)
    return chosen


def _cost(shape: Shape, piece: Shape) -> float:
    """Metres of an object's move and change."""
    distance = float(np.hypot(shape.pose.row - piece.pose.row, shape.pose.column - piece.pose.column)) * CELL
    fragment = PENALTY if piece.area < FRAGMENT * shape.area else 0.0
    return min(distance, FARTHEST) + fragment + float(np.abs(_features(shape) - _features(piece)).sum())


def _features(shape: Shape) -> NDArray[np.float64]:
    """Invariants of a moving object [2]: the root of its area, and its height; metres."""
    return np.array([np.sqrt(shape.area) * CELL, np.percentile(shape.patch[shape.patch > 0.0], 90)])


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

    `region`: [I, J] its cells. `heights`: [I, J] the map of that time. `shape`: from when it last stood alone, at its
    last pose.
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
    # Noise makes outlines flicker: a thin seam around an unmoved object belongs to it.
    seams = ndimage.binary_dilation(taken, AROUND)
    pieces = _connected(ndimage.binary_closing(heights.occupied & ~seams, AROUND) & ~seams)
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


def _connected(cells: Mask) -> list[Mask]:
    """The connected regions of some cells [I, J] that are large enough for an object."""
    labels, count = ndimage.label(cells, AROUND)
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


CLICK = 8  # cells, tolerance of the person who points at the target
NO_PIXELS: Pixels = (np.zeros(0, np.intp), np.zeros(0, np.intp))


class ClusterSegmenter:
    """Finds objects by clustering the points above the table, at most `slots` of them.

    Both methods raise ValueError if the image shows no table.
    """

    def __init__(self, slots: int = OBJECT_SLOTS) -> None:
        self._slots = slots
        self._tracks: list[Track | None] = []

    def start(self, image: DepthImage, target: tuple[int, int] | None) -> list[Pixels]:
        heights = map_heights(image)
        regions = find_objects(heights)
        first = _confirmed(regions, image, target)
        others = [region for number, region in enumerate(regions) if number != first]
        kept = [None if first is None else regions[first], *others][: self._slots]
        self._tracks = [None if region is None else begin_track(region, heights) for region in kept]
        return pixels_of(kept, heights)

    def follow(self, image: DepthImage) -> list[Pixels]:
        heights = map_heights(image)
        found = follow_tracks(self._tracks, heights)
        for number, track in enumerate(found):
            if track is not None:
                self._tracks[number] = track
        return pixels_of([None if track is None else track.region for track in found], heights)


def find_objects(heights: HeightMap) -> list[Mask]:
    """The regions [I, J] of all objects on a height map, the largest first."""
    regions = [part for region in find_regions(heights) for part in split_at_necks(region)]
    return sorted(regions, key=lambda region: -int(region.sum()))


def _confirmed(regions: list[Mask], image: DepthImage, target: tuple[int, int] | None) -> int | None:
    """The region at the confirmed pixel, or the nearest within a person's aim."""
    if target is None or not regions:
        return None
    (cell,), (inside,) = cells_of(image, (np.array([target[0]]), np.array([target[1]])))
    if not inside:
        return None
    distances = [ndimage.distance_transform_edt(~region)[tuple(cell)] for region in regions]
    nearest = int(np.argmin(distances))
    return nearest if distances[nearest] <= CLICK else None


def pixels_of(regions: list[Mask | None], heights: HeightMap) -> list[Pixels]:
    """Pixels of each region; including the floors of vessels, which are hardly above the table."""
    rows, columns = heights.pixels
    found = []
    for region in regions:
        if region is None:
            found.append(NO_PIXELS)
            continue
        own = region[tuple(heights.cells.T)]
        pixels = rows[own], columns[own]
        inside = _inside(region) & ~region
        if inside.any() and len(pixels[0]):
            low = _floor(heights, inside, pixels)
            pixels = np.concatenate([pixels[0], low[0]]), np.concatenate([pixels[1], low[1]])
        found.append(pixels)
    return found


def _inside(region: Mask) -> Mask:
    """A region [I, J] with its holes filled."""
    filled = np.zeros_like(region)
    if region.any():
        box = box_around(region, 0)
        filled[box] = ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(region[box], 2), AROUND)[2:-2, 2:-2])
    return filled


def _floor(heights: HeightMap, inside: Mask, pixels: Pixels) -> Pixels:
    """Pixels over the cells `inside` that do not rise above the table, looked for around an object's own `pixels`."""
    box = tuple(slice(int(axis.min()), int(axis.max()) + 1) for axis in pixels)
    window = np.zeros(heights.above.shape, np.bool_)
    window[box] = True
    window[heights.pixels] = False
    rows, columns = np.nonzero(window & (heights.image.depth > 0.0))
    cells, on_map = cells_of(heights.image, (rows, columns))
    own = np.zeros(len(rows), np.bool_)
    own[on_map] = inside[tuple(cells[on_map].T)]
    return rows[own], columns[own]
