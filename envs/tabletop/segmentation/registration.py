"""Registration of objects in contact, by their shapes from above, taken when they stood alone.

Analysis by synthesis: place the shapes on the height map so that together they explain it at the lowest cost, without
overlaps. The search places one shape after the other where it lowers the cost most, in several orders; then it removes
and places each one again until the cost stops falling (block coordinate descent, each step a search over all poses),
and exchanges pairs of similar shapes. All costs are in cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from cavin_pyro.envs.tabletop.segmentation.height_map import AROUND, CELL, Mask


@dataclass(frozen=True)
class Pose:
    """The position of a shape's middle on a map (row, column), in cells, and its rotation, radians."""

    row: float
    column: float
    turn: float = 0.0


@dataclass(frozen=True)
class Shape:
    """Heights of an object's cells, and its last pose.

    `patch`: [h, w] metres above the table; 0 outside of the object. `middle`: (row, column) in the patch of the cell at
    `pose`. `pose`: the last observed one.
    """

    patch: NDArray[np.float32]
    middle: tuple[int, int]
    pose: Pose

    @property
    def area(self) -> int:
        """In cells."""
        return int((self.patch > 0.0).sum())

    def shifted(self, rows: int, columns: int) -> Shape:
        """The same shape on a map with another origin."""
        return replace(self, pose=replace(self.pose, row=self.pose.row + rows, column=self.pose.column + columns))

    def covered_cells(self, pose: Pose) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """The cells [C, 2] that the shape covers at a pose, and its heights there [C]; each takes the nearest's."""
        high, wide = self.patch.shape
        cosine, sine = np.cos(pose.turn), np.sin(pose.turn)
        corners = np.array([(0, 0), (0, wide - 1), (high - 1, 0), (high - 1, wide - 1)]) - self.middle
        moved = corners @ np.array([[cosine, sine], [-sine, cosine]]) + (pose.row, pose.column)
        lowest, highest = np.floor(moved.min(axis=0)).astype(int), np.ceil(moved.max(axis=0)).astype(int)
        rows, columns = (np.arange(low, top + 1) for low, top in zip(lowest, highest, strict=True))
        down, right = (rows - pose.row)[:, None], (columns - pose.column)[None]
        source_rows = np.rint(cosine * down + sine * right + self.middle[0]).astype(np.intp)
        source_columns = np.rint(cosine * right - sine * down + self.middle[1]).astype(np.intp)
        inside = (source_rows >= 0) & (source_rows < high) & (source_columns >= 0) & (source_columns < wide)
        heights = np.where(inside, self.patch[source_rows % high, source_columns % wide], 0.0).astype(np.float32)
        covered = np.nonzero(heights)
        return np.stack((rows[covered[0]], columns[covered[1]]), axis=-1), heights[covered]


def shape_of(region: Mask, heights: NDArray[np.float32]) -> Shape:
    """The shape of a region [I, J], not empty, of a map of heights [I, J], with its little gaps closed."""
    rows, columns = np.nonzero(region)
    first = int(rows.min()), int(columns.min())
    box = slice(first[0], int(rows.max()) + 1), slice(first[1], int(columns.max()) + 1)
    # The cell nearest to the mean lies on the object, even if that is bent.
    middle = int(((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2).argmin())
    row, column = int(rows[middle]), int(columns[middle])
    closed = ndimage.binary_closing(np.pad(region[box], 1), AROUND)[1:-1, 1:-1]
    patch = np.where(closed, heights[box], 0.0).astype(np.float32)
    return Shape(patch, (row - first[0], column - first[1]), Pose(row, column))


LEVEL = 0.004  # metres; heights are compared in steps of this
TOLERANCE, CAP = 0.004, 0.02  # metres of height by which a cell may differ at no cost, and where the cost is highest
MISFIT = 0.7  # highest cost of a cell on which a shape lies; a cell on which none lies costs 1
EMPTY, OVERLAP = 0.7, 0.7  # cost of a shape's cell where nothing stands, and of one where another shape lies already
PRESENT = 0.2  # fraction of its cells by which a shape must lower the cost, or it counts as occluded
# Fractions of its cells: the cost of moving a shape by 0.1 m and of rotating it by a radian. The cost grows faster than
# the distance, so that similar objects that are pushed in a row do not exchange identities.
MOVING, TURNING, POWER = 0.1, 0.05, 1.5
TURNS = np.radians(np.arange(-96, 97, 12))  # radians, searched
STRIDE = 2  # cells between the places that are searched
NEAR = 8  # cells around an approximately known place to search
SAMPLE = 80  # cells of a shape, about, that a search evaluates
REFINED = 3  # best results of a search to refine
COARSE, FINE = (1.0, 0.1), (0.5, 0.05)  # steps of refining: cells and radians

Table = NDArray[np.float32]
"""Savings per cell from a shape, by the level of its height there: [1 + occupied cells, levels], the first is empty."""


class Arrangement:
    """Poses of shapes on a map.

    `heights`: [I, J] the map, metres; 0 where nothing is to be explained. `shapes`: those to place; initially none is
    placed.
    """

    def __init__(self, heights: NDArray[np.float32], shapes: Sequence[Shape]) -> None:
        self.shapes, self.areas = shapes, [shape.area for shape in shapes]
        self.poses: dict[int, Pose] = {}
        self._layers: dict[int, tuple[NDArray[np.intp], NDArray[np.intp]]] = {}
        self._turned: dict[tuple[int, Pose], tuple[NDArray[np.intp], NDArray[np.intp]]] = {}
        self._border = 2 + max(sum(shape.patch.shape) for shape in shapes)
        self._occupied = np.argwhere(heights > 0.0)
        rows = np.zeros(heights.shape, np.intp)  # of the table
        rows[heights > 0.0] = 1 + np.arange(len(self._occupied))
        self._rows = np.pad(rows, self._border)
        observed = np.append(0.0, heights[heights > 0.0])
        levels = LEVEL * np.arange(2 + int(max(shape.patch.max() for shape in shapes) / LEVEL))
        excess = (np.abs(observed[:, None] - levels) - TOLERANCE) / (CAP - TOLERANCE)
        self._misfit = (MISFIT * np.clip(excess, 0.0, 1.0)).astype(np.float32)

    def place(self, number: int, pose: Pose | None) -> None:
        """Place a shape at a pose, or remove it."""
        self.poses.pop(number, None)
        self._layers.pop(number, None)
        if pose is not None:
            self.poses[number], self._layers[number] = pose, self._layer(number, pose)

    def place_only(self, poses: Mapping[int, Pose]) -> None:
        """Place these shapes and no others."""
        for number in range(len(self.shapes)):
            self.place(number, poses.get(number))

    def savings(self, number: int) -> Table:
        """Savings from this shape, given the others."""
        cost, covered = np.ones(len(self._misfit), np.float32), np.zeros(len(self._misfit), np.bool_)
        for other, (rows, levels) in self._layers.items():
            if other != number:
                cost[rows] = np.minimum(cost[rows], self._misfit[rows, levels])
                covered[rows] = True
        table = np.maximum(cost[:, None] - self._misfit, 0.0) - OVERLAP * covered[:, None]
        table[0] = -EMPTY
        return table.astype(np.float32)

    def saved(self, number: int) -> float:
        """Savings from a placed shape; for another one, the savings that it needs to be placed."""
        if number not in self.poses:
            return PRESENT * self.areas[number]
        return self.gain(number, self.poses[number], self.savings(number))

    def gain(self, number: int, pose: Pose, table: Table) -> float:
        """Savings from a shape at a pose, less the cost of moving there."""
        moving = self._moving(number, np.array([pose.row, pose.column]), pose.turn)
        return float(table[self._layer(number, pose)].sum() - moving)

    def search(self, number: int, table: Table, near: Pose | None = None) -> tuple[float, Pose]:
        """The largest savings from a shape and its pose, among all poses or those `near` another."""
        width, shape, former = self._rows.shape[1], self.shapes[number], near or self.shapes[number].pose
        places = self._occupied[(self._occupied % STRIDE == 0).all(axis=1) & (table[1:].max(axis=1) > 0.0)]
        if near is not None:
            places = places[np.hypot(*(places - (near.row, near.column)).T) <= NEAR]
        start, rows = (places + self._border) @ (width, 1), self._rows.ravel()
        found = []
        for turn in (shape.pose.turn + TURNS).tolist() if len(places) else ():
            cells, levels = self._turn(number, Pose(0.0, 0.0, turn))
            step = max(1, len(cells) // SAMPLE)
            levels, offsets = levels[::step], cells[::step] @ (width, 1)
            saved = table[rows[start[:, None] + offsets], levels].sum(axis=1) * (self.areas[number] / len(levels))
            saved = saved - self._moving(number, places, turn)
            best = int(saved.argmax())
            found.append((float(saved[best]), Pose(int(places[best, 0]), int(places[best, 1]), turn)))
        chosen = [pose for _, pose in sorted(found, key=lambda one: -one[0])[:REFINED]]
        return max((self.refine(number, pose, table) for pose in (former, *chosen)), key=lambda one: one[0])

    def refine(self, number: int, pose: Pose, table: Table, steps: tuple[float, float] = COARSE) -> tuple[float, Pose]:
        """Move and rotate a shape by steps (cells, radians) while the savings grow."""
        step, turn = steps
        gain = self.gain(number, pose, table)
        while True:
            around = [replace(pose, row=pose.row + sign * step) for sign in (1, -1)]
            around += [replace(pose, column=pose.column + sign * step) for sign in (1, -1)]
            around += [replace(pose, turn=pose.turn + sign * turn) for sign in (1, -1)]
            better, other = max(((self.gain(number, one, table), one) for one in around), key=lambda one: one[0])
            if better <= gain:
                return gain, pose
            gain, pose = better, other

    def total(self) -> float:
        """The cost of the map with the placed shapes."""
        cost, count, total = np.ones(len(self._misfit)), np.zeros(len(self._misfit)), 0.0
        for number, (rows, levels) in self._layers.items():
            pose = self.poses[number]
            cost[rows] = np.minimum(cost[rows], self._misfit[rows, levels])
            count[rows] += 1
            total += EMPTY * (rows == 0).sum() + PRESENT * self.areas[number]
            total += float(self._moving(number, np.array([pose.row, pose.column]), pose.turn))
        return float(total + cost[1:].sum() + OVERLAP * np.maximum(count[1:] - 1, 0).sum())

    def owners(self) -> NDArray[np.intp]:
        """For each cell [I, J] the shape that covers it with the smallest difference; -1 for none."""
        owner, least = np.full(len(self._misfit), -1), np.full(len(self._misfit), np.inf)
        for number, (rows, levels) in self._layers.items():
            better = self._misfit[rows, levels] < least[rows]
            owner[rows[better]], least[rows[better]] = number, self._misfit[rows, levels][better]
        owner[0] = -1
        return owner[self._rows[self._border : -self._border, self._border : -self._border]]

    def _layer(self, number: int, pose: Pose) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Row of the table and level of each cell of a shape."""
        row, column = int(np.floor(pose.row)), int(np.floor(pose.column))
        cells, levels = self._turn(number, Pose(pose.row - row, pose.column - column, pose.turn))
        cells = np.clip(cells + (row + self._border, column + self._border), 0, np.array(self._rows.shape) - 1)
        return self._rows[cells[:, 0], cells[:, 1]], levels

    def _turn(self, number: int, pose: Pose) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Cells and levels of a shape, computed once for all poses that differ by whole cells."""
        if (number, pose) not in self._turned:
            cells, heights = self.shapes[number].covered_cells(pose)
            self._turned[number, pose] = cells, np.rint(heights / LEVEL).astype(np.intp)
        return self._turned[number, pose]

    def _moving(self, number: int, places: NDArray[np.floating | np.intp], turn: float) -> NDArray[np.float64]:
        """The cost of moving a shape to places [..., 2] and rotating it."""
        last = self.shapes[number].pose
        distance = np.hypot(places[..., 0] - last.row, places[..., 1] - last.column) * CELL
        return self.areas[number] * (MOVING * (distance / 0.1) ** POWER + TURNING * abs(turn - last.turn))


ORDERS, SWEEPS = 6, 3  # at most
IMPROVEMENT = 0.5  # cells, at least, that another arrangement must save
GOOD = 0.75  # of a shape's cells; with such savings a shape is not searched elsewhere
POOR = 0.6  # of a shape's cells; with smaller savings, objects assumed to be at rest may have moved
EXCHANGED = 0.4  # ratio of the areas, at least, of two shapes that may be confused


def explain(heights: NDArray[np.float32], shapes: Sequence[Shape], still: Sequence[int]) -> Arrangement:
    """Place shapes on a map [I, J]; those in `still` hardly move, unless another shape stays unexplained."""
    arrangement = Arrangement(heights, shapes)
    _arrange(arrangement, still)
    if still and any(arrangement.saved(number) < POOR * shape.area for number, shape in enumerate(shapes)):
        poses, total = dict(arrangement.poses), arrangement.total()
        _arrange(arrangement, ())
        if arrangement.total() > total:
            arrangement.place_only(poses)
    return arrangement


def _arrange(arrangement: Arrangement, still: Sequence[int]) -> None:
    """Place all shapes at the lowest cost; those in `still` move a little at most."""
    shapes = arrangement.shapes
    movable = [number for number in range(len(shapes)) if number not in still]
    movable.sort(key=lambda number: -shapes[number].area)
    begun = []
    for start, order in _starts(arrangement, movable):
        arrangement.place_only({number: shapes[number].pose for number in (*still, *start)})
        for number in order:
            gain, pose = arrangement.search(number, arrangement.savings(number))
            arrangement.place(number, pose if gain > PRESENT * shapes[number].area else None)
        begun.append((arrangement.total(), dict(arrangement.poses)))
        if all(arrangement.saved(number) > GOOD * shape.area for number, shape in enumerate(shapes)):
            break
    arrangement.place_only(min(begun, key=lambda one: one[0])[1])
    for _ in range(SWEEPS):
        improved = [_place_anew(arrangement, number, number in still) for number in range(len(shapes))]
        if not any(improved):
            exchanged = [_exchange(arrangement, *pair) for pair in combinations(movable, 2)]
            if not any(exchanged):
                break
    for number, pose in list(arrangement.poses.items()):
        arrangement.place(number, arrangement.refine(number, pose, arrangement.savings(number), FINE)[1])


def _starts(arrangement: Arrangement, movable: Sequence[int]) -> Iterator[tuple[Sequence[int], Sequence[int]]]:
    """Shapes to leave at their last poses, and orders to place the others; the best guess comes first."""
    arrangement.place_only({number: shape.pose for number, shape in enumerate(arrangement.shapes)})
    areas = arrangement.areas
    stay = [number for number in movable if arrangement.saved(number) >= POOR * areas[number]]
    if stay:
        yield stay, [number for number in movable if number not in stay]
    orders = list(permutations(movable))
    for order in orders[:: -(-len(orders) // ORDERS)]:
        yield (), order


def _place_anew(arrangement: Arrangement, number: int, still: bool) -> bool:
    """Place a shape where it saves the most, given the others; returns whether it moved."""
    table, former = arrangement.savings(number), arrangement.saved(number)
    least = PRESENT * arrangement.areas[number]
    if still or former > GOOD * arrangement.areas[number]:
        gain, pose = arrangement.refine(number, arrangement.poses[number], table)
    else:
        gain, pose = arrangement.search(number, table)
    if max(gain, least) <= former + IMPROVEMENT:
        return False
    arrangement.place(number, pose if gain > least or still else None)
    return True


def _exchange(arrangement: Arrangement, one: int, other: int) -> bool:
    """Exchange the places of two shapes if this saves more; returns whether it does."""
    poses, total = dict(arrangement.poses), arrangement.total()
    small, large = sorted(arrangement.areas[number] for number in (one, other))
    if one not in poses or other not in poses or small < EXCHANGED * large:
        return False
    arrangement.place(one, None)
    arrangement.place(other, None)
    for number, there in ((one, other), (other, one)):
        arrangement.place(number, arrangement.search(number, arrangement.savings(number), near=poses[there])[1])
    if arrangement.total() < total - IMPROVEMENT:
        return True
    arrangement.place_only(poses)
    return False
