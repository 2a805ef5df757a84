"""From a depth image to a height map: the height above the table, for each cell of the table.

In the image, a tall object leans outwards and occludes others; on the map objects are as separate as on the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from cavin_pyro.envs.tabletop.segmentation.segmenter import Pixels
from cavin_pyro.envs.tabletop.sensors.camera import RAY_COLUMN, RAY_ROW
from cavin_pyro.envs.tabletop.sensors.sensor import DepthImage
from cavin_pyro.envs.tabletop.workspace import TABLE_HIGH, TABLE_LOW

CELL = 0.004  # metres; a little more than what a pixel of the Kinect2 shows from one metre
MARGIN = 0.06  # metres around the table
LOWEST, HIGHEST = 0.008, 0.35  # metres above the table; range of heights that count as an object
STRIDE = 6  # the fit of the table uses every sixth pixel on each axis
TRIMMING = (0.04, 0.02, 0.01, 0.006)  # metres from the table beyond which a pixel is left out of the next fit
ORIGIN = np.array(TABLE_LOW) - MARGIN  # metres
SHAPE = tuple(int(side) for side in np.ceil((np.array(TABLE_HIGH) + MARGIN - ORIGIN) / CELL))

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class HeightMap:
    """Heights of the objects on the table.

    Attributes:
        heights: [I, J] metres above the table of the highest point on each cell; 0 where nothing stands.
        pixels: rows and columns of the pixels above the table, each [P]. cells: [P, 2] the cell of each of them.
        above: [height, width] metres above the fitted table, for all pixels.
    """

    image: DepthImage
    heights: NDArray[np.float32]
    pixels: Pixels
    cells: NDArray[np.intp]
    above: NDArray[np.float32]

    @property
    def occupied(self) -> Mask:
        """Cells with an object, [I, J]."""
        return self.heights > 0.0

    @cached_property
    def filled(self) -> NDArray[np.float32]:
        """The same heights, with gaps up to two cells wide filled from their surroundings."""
        return np.where(self.occupied, self.heights, ndimage.grey_closing(self.heights, (3, 3))).astype(np.float32)


def map_heights(image: DepthImage) -> HeightMap:
    """Fit the table's plane and map the heights above it. Raises ValueError: the image shows no table."""
    camera, depth = image.camera, image.depth
    plane = fit_table(image)
    along_row, along_column, column, row = camera.intrinsics
    right = (np.arange(camera.width) + RAY_COLUMN - column) / along_row
    down = (np.arange(camera.height) + RAY_ROW - row) / along_column
    inverse = (plane[0] * right + plane[2]) + (plane[1] * down)[:, None]  # of the table's depth at each pixel
    above = ((1.0 - depth * inverse.astype(np.float32)) / np.linalg.norm(plane)).astype(np.float32)
    rows, columns = np.nonzero((above > LOWEST) & (above < HIGHEST) & (depth > 0.0))
    cells, inside = cells_of(image, (rows, columns))
    rows, columns, cells = rows[inside], columns[inside], cells[inside]
    heights = np.zeros(SHAPE, np.float32)
    for covered in _covered(image, (rows, columns), cells):
        np.maximum.at(heights, (covered[:, 0], covered[:, 1]), above[rows, columns])
    return HeightMap(image, heights, (rows, columns), cells, above)


def _covered(image: DepthImage, pixels: Pixels, cells: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """The cells that pixels cover: their own, and where a pixel shows more than a cell, those around it too."""
    side = float(np.median(image.depth[pixels])) / image.camera.focal_length if len(cells) else 0.0
    if side <= CELL:
        return [cells]
    points = image.camera.points(image.depth, *pixels)[:, :2]
    shifts = [np.array([x, y]) * side / 4 for x in (-1, 1) for y in (-1, 1)]
    covered = [np.floor((points + shift - ORIGIN) / CELL).astype(np.intp) for shift in shifts]
    return [np.clip(one, 0, np.array(SHAPE) - 1) for one in covered]


def cells_of(image: DepthImage, pixels: Pixels) -> tuple[NDArray[np.intp], Mask]:
    """The cell [P, 2] over which each pixel's point lies, and whether that is on the map [P]."""
    points = image.camera.points(image.depth, *pixels)
    cells = np.floor((points[:, :2] - ORIGIN) / CELL).astype(np.intp)
    inside = np.all((cells >= 0) & (cells < SHAPE), axis=-1)
    return cells, np.asarray(inside, dtype=np.bool_)


def fit_table(image: DepthImage) -> NDArray[np.float64]:
    """The plane that most of the image lies in: [3] n such that n . p = 1 for its points p in the image's axes.

    Repeated least squares without the points far from the last plane; the first plane is level, at the median height.
    Objects must cover less than half of what is observed. Raises ValueError: the image shows no table.
    """
    camera = image.camera
    rows, columns = np.mgrid[STRIDE // 2 : camera.height : STRIDE, STRIDE // 2 : camera.width : STRIDE].reshape(2, -1)
    depth = image.depth[rows, columns].astype(np.float64)
    points = camera.rays(rows, columns)[depth > 0.0] * depth[depth > 0.0][:, None]
    level = -camera.axes[:, 2]
    for trimming in TRIMMING:
        if trimming == TRIMMING[0]:
            plane = level / np.median(points @ level) if len(points) else level
        near = np.abs(1.0 - points @ plane) / np.linalg.norm(plane) < trimming
        if near.sum() < 3:
            raise ValueError("no table in the depth image: too few pixels have a measurement")
        plane, *_ = np.linalg.lstsq(points[near], np.ones(int(near.sum())), rcond=None)
    return plane


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
