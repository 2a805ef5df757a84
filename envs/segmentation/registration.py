"""Telling apart objects that touch, by the shapes that they had when they stood alone.

Analysis by synthesis: the shapes are laid over the map of heights so that together they explain as much of it as they
can, and nothing that is not there, without overlapping. One shape after the other is laid where it explains the most
of what the others leave over (block coordinate descent; each step searches all places and turns), beginning in
several orders; then all are moved and turned a little, as long as that helps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from envs.segmentation.height_map import CELL, Mask

TOLERANCE, CAP = 0.004, 0.02  # metres of height by which a cell may differ at no cost, and from which it costs 1
EMPTY, OVERLAP = 0.7, 0.7  # what a cell of a shape costs where nothing stands, and where another shape lies
PRESENT = 0.2  # of its cells that a shape must save, or it is not there
PER_METRE, PER_RADIAN = 1.0, 0.05  # of its cells that moving and turning a shape costs
TURNS = np.radians(np.arange(-96, 97, 12))  # radians that are searched
STRIDE = 2  # cells between the places that are searched
SAMPLE = 80  # cells, about, by which a shape is judged in the search
ORDERS = 4  # orders of the shapes, at most, to begin with
SWEEPS = 3


@dataclass(frozen=True)
class Pose:
    """Where a shape's middle lies on the map (row, column), in cells, and how far it is turned, radians."""

    row: float
    column: float
    turn: float


@dataclass(frozen=True)
class Shape:
    """An object's heights when it stood alone, and where it was last.

    Attributes:
        patch: [h, w] metres above the table; 0 where it is not. middle: [2] cells in the patch. pose: see `Pose`.
    """

    patch: NDArray[np.float32]
    middle: tuple[float, float]
    pose: Pose

    @property
    def area(self) -> int:
        """In cells."""
        return int((self.patch > 0.0).sum())


def shape_of(region: Mask, heights: NDArray[np.float32]) -> Shape:
    """The shape of a region of the map that is not empty."""
    rows, columns = np.nonzero(region)
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    patch = np.where(region[box], heights[box], 0.0).astype(np.float32)
    # The cell nearest to the middle, so that it lies on the object, however bent that is.
    at = int(((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2).argmin())
    row, column = int(rows[at]), int(columns[at])
    return Shape(patch, (row - int(rows.min()), column - int(columns.min())), Pose(row, column, 0.0))


def turned(shape: Shape, turn: float, row: float = 0.0, column: float = 0.0) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """The cells [C, 2] that a turned shape covers when its middle is at (row, column), and its heights there [C]."""
    high, wide = shape.patch.shape
    corners = np.array([(0, 0), (0, wide - 1), (high - 1, 0), (high - 1, wide - 1)]) - shape.middle
    cosine, sine = np.cos(turn), np.sin(turn)
    moved = corners @ np.array([[cosine, sine], [-sine, cosine]]) + (row, column)
    low, top = np.floor(moved.min(axis=0)).astype(int), np.ceil(moved.max(axis=0)).astype(int)
    rows, columns = np.arange(low[0], top[0] + 1), np.arange(low[1], top[1] + 1)
    down, right = (rows - row)[:, None], (columns - column)[None]
    source_rows = np.rint(cosine * down + sine * right + shape.middle[0]).astype(np.intp)
    source_columns = np.rint(cosine * right - sine * down + shape.middle[1]).astype(np.intp)
    inside = (source_rows >= 0) & (source_rows < high) & (source_columns >= 0) & (source_columns < wide)
    heights = np.zeros(inside.shape, np.float32)
    heights[inside] = shape.patch[source_rows[inside], source_columns[inside]]
    covered = np.nonzero(heights)
    return np.stack((rows[covered[0]], columns[covered[1]]), axis=-1), heights[covered]


class Explanation:
    """Which shapes lie where on a map, and how well they explain it.

    Args:
        heights: [I, J] the map; 0 where nothing is to be explained.
    """

    def __init__(self, heights: NDArray[np.float32], shapes: Sequence[Shape]) -> None:
        self.heights, self.shapes = heights, shapes
        self.poses: dict[int, Pose] = {}
        # A border, so that shapes may reach beyond the map.
        self.border = max(int(np.hypot(*shape.patch.shape)) for shape in shapes) + 2
        self.padded = np.pad(heights, self.border)
        self.layers: dict[int, tuple[NDArray[np.intp], NDArray[np.float32]]] = {}

    def _layer(self, number: int, pose: Pose) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        cells, heights = turned(self.shapes[number], pose.turn, pose.row, pose.column)
        inside = np.all((cells + self.border >= 0) & (cells + self.border < self.padded.shape), axis=-1)
        flat = np.ravel_multi_index(tuple((cells[inside] + self.border).T), self.padded.shape)
        return flat, heights[inside]

    def place(self, number: int, pose: Pose | None) -> None:
        self.poses.pop(number, None)
        self.layers.pop(number, None)
        if pose is not None:
            self.poses[number] = pose
            self.layers[number] = self._layer(number, pose)

    def residual(self, without: int | None = None) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """What each cell costs as the shapes lie, 0 to 1, and whether any lies on it, without one of them; flat."""
        flat = self.padded.ravel()
        cost = (flat > 0.0).astype(np.float32)
        covered = np.zeros(flat.shape, np.bool_)
        for number, (cells, heights) in self.layers.items():
            if number != without:
                cost[cells] = np.minimum(cost[cells], _differ(flat[cells], heights))
                covered[cells] = True
        return cost, covered

    def prior(self, number: int, rows, columns, turn) -> NDArray[np.float64]:
        old = self.shapes[number].pose
        distance = np.hypot(rows - old.row, columns - old.column) * CELL
        away = np.abs(turn - old.turn)
        return self.shapes[number].area * (PER_METRE * distance + PER_RADIAN * away)

    def gain(self, number: int, pose: Pose, residual) -> float:
        """What is saved by laying a shape at a pose."""
        cost, covered = residual
        cells, heights = self._layer(number, pose)
        saved = _saved(self.padded.ravel()[cells], heights, cost[cells], covered[cells]).sum()
        return float(saved - self.prior(number, pose.row, pose.column, pose.turn))

    def search(self, number: int, residual) -> tuple[float, Pose]:
        """The pose at which a shape saves the most, and what it saves."""
        cost, covered = residual
        shape, flat, width = self.shapes[number], self.padded.ravel(), self.padded.shape[1]
        uncovered = ~covered.reshape(self.padded.shape)[self.border : -self.border, self.border : -self.border]
        rows, columns = np.nonzero((self.heights > 0.0) & uncovered)
        even = (rows % STRIDE == 0) & (columns % STRIDE == 0)
        rows, columns = rows[even], columns[even]
        if len(rows) == 0:
            return -np.inf, shape.pose
        places = (rows + self.border) * width + columns + self.border
        best: list[tuple[float, Pose]] = []
        for turn in TURNS:
            cells, heights = turned(shape, shape.pose.turn + turn)
            step = max(1, len(cells) // SAMPLE)
            cells, heights = cells[::step], heights[::step]
            offsets = cells[:, 0] * width + cells[:, 1]
            at = places[:, None] + offsets[None]
            np.clip(at, 0, flat.size - 1, out=at)
            saved = _saved(flat[at], heights[None], cost[at], covered[at]).sum(axis=1) * (shape.area / len(cells))
            saved = saved - self.prior(number, rows, columns, shape.pose.turn + turn)
            for index in np.argsort(saved)[-2:]:
                best.append((float(saved[index]), Pose(int(rows[index]), int(columns[index]), shape.pose.turn + turn)))
        best.append((0.0, shape.pose))
        best.sort(key=lambda one: -one[0])
        refined = [self.refine(number, pose, residual) for pose in {pose: 0 for _, pose in best[:5]} | {shape.pose: 0}]
        return max(refined, key=lambda one: one[0])

    def refine(self, number: int, pose: Pose, residual) -> tuple[float, Pose]:
        """Move and turn a shape a little as long as that helps."""
        gain = self.gain(number, pose, residual)
        for step, turn in ((1.0, 0.1), (0.5, 0.05)):
            for _ in range(8):
                options = [
                    replace(pose, row=pose.row + step), replace(pose, row=pose.row - step),
                    replace(pose, column=pose.column + step), replace(pose, column=pose.column - step),
                    replace(pose, turn=pose.turn + turn), replace(pose, turn=pose.turn - turn),
                ]
                found = [(self.gain(number, option, residual), option) for option in options]
                better, option = max(found, key=lambda one: one[0])
                if better <= gain:
                    break
                gain, pose = better, option
        return gain, pose

    def total(self) -> float:
        cost, _ = self.residual()
        total = float(cost.sum())
        count = np.zeros(cost.shape, np.int16)
        for number, (cells, _) in self.layers.items():
            pose = self.poses[number]
            total += float(self.prior(number, pose.row, pose.column, pose.turn))
            count[cells] += 1
        total += EMPTY * float((count[self.padded.ravel() == 0.0]).sum())
        total += OVERLAP * float(np.maximum(count[self.padded.ravel() > 0.0] - 1, 0).sum())
        total += PRESENT * sum(self.shapes[number].area for number in self.poses)
        return total

    def owners(self) -> NDArray[np.intp]:
        """The number of the shape that explains each cell [I, J] best; -1 for cells that no shape explains."""
        owner = np.full(self.padded.size, -1)
        least = np.full(self.padded.size, np.inf)
        flat = self.padded.ravel()
        for number, (cells, heights) in self.layers.items():
            differ = np.abs(flat[cells] - heights)
            better = (flat[cells] > 0.0) & (differ < least[cells])
            owner[cells[better]], least[cells[better]] = number, differ[better]
        b = self.border
        return owner.reshape(self.padded.shape)[b:-b, b:-b]


def _differ(seen, heights):
    return np.clip((np.abs(seen - heights) - TOLERANCE) / (CAP - TOLERANCE), 0.0, 1.0)


def _saved(seen, heights, cost, covered):
    gained = cost - np.minimum(cost, _differ(seen, heights)) - OVERLAP * covered
    return np.where(seen > 0.0, gained, -EMPTY)


def explain(heights: NDArray[np.float32], shapes: Sequence[Shape], still: Sequence[int]) -> Explanation:
    """Lay shapes over a map; those in `still` are known to have hardly moved."""
    movable = [number for number in range(len(shapes)) if number not in still]
    movable.sort(key=lambda number: -shapes[number].area)
    orders = list(permutations(movable))
    if len(orders) > ORDERS:
        orders = [orders[int(i)] for i in np.linspace(0, len(orders) - 1, ORDERS)]
    best = None
    for order in orders:
        one = Explanation(heights, shapes)
        for number in still:
            one.place(number, shapes[number].pose)
        for number in order:
            gain, pose = one.search(number, one.residual(number))
            one.place(number, pose if gain > PRESENT * shapes[number].area else None)
        total = one.total()
        if best is None or total < best[0]:
            best = total, one
    total, one = best
    for _ in range(SWEEPS):
        changed = False
        for number in range(len(shapes)):
            residual = one.residual(number)
            least = PRESENT * shapes[number].area
            old = one.gain(number, one.poses[number], residual) if number in one.poses else least
            look = one.refine if number in still else lambda n, pose, r: one.search(n, r)
            gain, pose = look(number, one.poses.get(number), residual)
            if max(gain, least) > old + 0.5:
                one.place(number, pose if gain > least else None)
                changed = True
        if not changed:
            break
    return one
