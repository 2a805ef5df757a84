"""Objects found in the depth image alone, as on a real robot.

It fits and removes the table's plane, projects the rest onto a height map, finds its connected regions, splits objects
in contact, and tracks objects from image to image by position and shape. The set of objects is that of the first image:
later regions count as noise or as parts of these.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from envs.segmentation.height_map import (
    AROUND,
    HeightMap,
    Mask,
    box_around,
    cells_of,
    find_regions,
    map_heights,
    split_at_necks,
)
from envs.segmentation.segmenter import Pixels
from envs.segmentation.tracking import Track, begin_track, follow_tracks
from envs.sensors.sensor import DepthImage
from envs.workspace import OBJECT_SLOTS

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
