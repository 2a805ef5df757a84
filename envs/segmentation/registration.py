"""Telling apart objects that touch, by the shapes that they had when they stood alone.

Analysis by synthesis: the shapes are laid over the map of heights so that together they explain as much of it as they
can, and nothing that is not there, without overlapping. One after the other is laid where it explains most of what
the others leave over, in several orders; then each is taken up and laid anew until nothing improves (block coordinate
descent, each step a search of all places and turns). Costs are in cells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from envs.segmentation.height_map import CELL
from envs.segmentation.shapes import Pose, Shape

LEVEL = 0.004  # metres; heights are compared in steps of this
TOLERANCE, CAP = 0.004, 0.02  # metres of height by which a cell may differ at no cost, and where the cost is highest
MISFIT = 0.7  # highest cost of a cell on which a shape lies; a cell on which none lies costs 1
EMPTY, OVERLAP = 0.7, 0.7  # cost of a shape's cell where nothing stands, and of one where another shape lies already
PRESENT = 0.2  # of its cells that a shape must save, or it is not there
PER_METRE, PER_RADIAN = 1.0, 0.05  # of its cells, the cost of moving and turning a shape
TURNS = np.radians(np.arange(-96, 97, 12))  # radians, searched
STRIDE = 2  # cells between the places that are searched
SAMPLE = 80  # cells, about, by which a shape is judged in the search
REFINED = 3  # best finds of a search that are refined
COARSE, FINE = (1.0, 0.1), (0.5, 0.05)  # steps of refining: cells and radians
NEAR = 8  # cells around another shape's place that are searched when two are exchanged
ORDERS, SWEEPS = 4, 3  # at most
IMPROVEMENT = 0.5  # cells that laying a shape anew must save
POOR = 0.6  # of a shape's cells; where one saves less, objects taken to stand still may not do so

Table = NDArray[np.float32]
"""What laying a shape saves on each cell, by the level of the shape's height there: [1 + occupied cells, levels]."""


class Layout:
    """Shapes on a map.

    Args:
        heights: [I, J] the map, metres; 0 where nothing is to be explained.
        shapes: none is on the map to begin with.
    """

    def __init__(self, heights: NDArray[np.float32], shapes: Sequence[Shape]) -> None:
        self.shapes, self.poses = shapes, dict[int, Pose]()
        self._areas = [shape.area for shape in shapes]
        self._layers: dict[int, tuple[NDArray[np.intp], NDArray[np.intp]]] = {}
        self._turned: dict[tuple[float, ...], tuple[NDArray[np.intp], NDArray[np.intp]]] = {}
        self._border = 2 + max(int(np.hypot(*shape.patch.shape)) for shape in shapes)
        self._occupied = np.argwhere(heights > 0.0)
        rows = np.zeros(heights.shape, np.intp)  # of the table; 0 where nothing stands
        rows[heights > 0.0] = 1 + np.arange(len(self._occupied))
        self._rows = np.pad(rows, self._border)
        seen = np.concatenate(([0.0], heights[heights > 0.0]))
        levels = LEVEL * np.arange(2 + int(max(shape.patch.max() for shape in shapes) / LEVEL))
        difference = np.abs(seen[:, None] - levels) - TOLERANCE
        self._misfit = (MISFIT * np.clip(difference / (CAP - TOLERANCE), 0.0, 1.0)).astype(np.float32)

    def lay(self, number: int, pose: Pose | None) -> None:
        """Lay a shape at a pose, or take it away."""
        self.poses.pop(number, None)
        self._layers.pop(number, None)
        if pose is not None:
            self.poses[number], self._layers[number] = pose, self._layer(number, pose)

    def set_out(self, poses: Mapping[int, Pose]) -> None:
        """Lay these shapes alone."""
        for number in range(len(self.shapes)):
            self.lay(number, poses.get(number))

    def savings(self, without: int) -> Table:
        """What laying one more shape saves, as the others lie."""
        cost, covered = np.ones(len(self._misfit), np.float32), np.zeros(len(self._misfit), np.bool_)
        for number, (rows, levels) in self._layers.items():
            if number != without:
                cost[rows] = np.minimum(cost[rows], self._misfit[rows, levels])
                covered[rows] = True
        table = np.maximum(cost[:, None] - self._misfit, 0.0) - OVERLAP * covered[:, None]
        table[0] = -EMPTY
        return table.astype(np.float32)

    def gain(self, number: int, pose: Pose, table: Table) -> float:
        """What laying a shape at a pose saves, less what it costs to move there."""
        return float(table[self._layer(number, pose)].sum() - self._moving(number, pose.row, pose.column, pose.turn))

    def search(self, number: int, table: Table, near: Pose | None = None) -> tuple[float, Pose]:
        """The pose, of all or of those `near` another, at which a shape saves the most, and how much."""
        shape, width = self.shapes[number], self._rows.shape[1]
        uncovered = np.append(False, table[1:].max(axis=1) > 0.0)
        places = self._occupied[(self._occupied % STRIDE == 0).all(axis=1) & uncovered[1:]]
        if near is not None:
            places = places[np.hypot(*(places - (near.row, near.column)).T) <= NEAR]
        start = (places + self._border) @ (width, 1)
        flat = self._rows.ravel()
        former = near or shape.pose
        found = [(self.gain(number, former, table), former)]
        for turn in (shape.pose.turn + TURNS).tolist() if len(places) else ():
            cells, levels = self._turn(number, Pose(0.0, 0.0, turn))
            step = max(1, len(cells) // SAMPLE)
            rows = flat[start[:, None] + cells[::step] @ (width, 1)]
            saved = table[rows, levels[::step]].sum(axis=1) * (self._areas[number] / rows.shape[1])
            saved = saved - self._moving(number, places[:, 0], places[:, 1], turn)
            best = int(saved.argmax())
            found.append((float(saved[best]), Pose(int(places[best, 0]), int(places[best, 1]), turn)))
        found = [found[0], *sorted(found[1:], key=lambda one: -one[0])[:REFINED]]
        return max((self.refine(number, pose, table, *COARSE) for _, pose in found), key=lambda one: one[0])

    def refine(self, number: int, pose: Pose, table: Table, step: float, turn: float) -> tuple[float, Pose]:
        """Move a shape by `step` cells and turn it by `turn` radians as long as that saves more."""
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
        """The cost of the map as the shapes lie."""
        cost, count = np.ones(len(self._misfit)), np.zeros(len(self._misfit))
        total = 0.0
        for number, (rows, levels) in self._layers.items():
            pose = self.poses[number]
            cost[rows] = np.minimum(cost[rows], self._misfit[rows, levels])
            count[rows] += 1
            total += EMPTY * (rows == 0).sum() + PRESENT * self._areas[number]
            total += self._moving(number, pose.row, pose.column, pose.turn)
        return float(total + cost[1:].sum() + OVERLAP * np.maximum(count[1:] - 1, 0).sum())

    def owners(self) -> NDArray[np.intp]:
        """For each cell [I, J] the shape that lies on it and differs least from it; -1 where none lies."""
        owner, least = np.full(len(self._misfit), -1), np.full(len(self._misfit), np.inf)
        for number, (rows, levels) in self._layers.items():
            better = self._misfit[rows, levels] < least[rows]
            owner[rows[better]], least[rows[better]] = number, self._misfit[rows, levels][better]
        owner[0] = -1
        return owner[self._rows[self._border : -self._border, self._border : -self._border]]

    def _layer(self, number: int, pose: Pose) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Row in the table and level of each cell of a shape."""
        row, column = int(np.floor(pose.row)), int(np.floor(pose.column))
        cells, levels = self._turn(number, Pose(pose.row - row, pose.column - column, pose.turn))
        cells = cells + (row + self._border, column + self._border)
        np.clip(cells, 0, np.array(self._rows.shape) - 1, out=cells)
        return self._rows[cells[:, 0], cells[:, 1]], levels

    def _turn(self, number: int, pose: Pose) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Cells and levels of a shape at a pose, once for all places that differ by whole cells."""
        key = (number, pose.row, pose.column, pose.turn)
        if key not in self._turned:
            cells, heights = self.shapes[number].laid(pose)
            self._turned[key] = cells, np.rint(heights / LEVEL).astype(np.intp)
        return self._turned[key]

    def _moving(self, number: int, row, column, turn):  # type: ignore[no-untyped-def]
        """What it costs to have moved from where the shape was last."""
        last = self.shapes[number].pose
        distance = np.hypot(row - last.row, column - last.column) * CELL
        return self._areas[number] * (PER_METRE * distance + PER_RADIAN * abs(turn - last.turn))


def explain(heights: NDArray[np.float32], shapes: Sequence[Shape], still: Sequence[int]) -> Layout:
    """Lay shapes over a map [I, J]; those in `still` have hardly moved, unless that leaves another unexplained."""
    layout = Layout(heights, shapes)
    _explain(layout, still)
    if still and any(_gain(layout, number) < POOR * shape.area for number, shape in enumerate(shapes)):
        poses, total = dict(layout.poses), layout.total()
        _explain(layout, ())
        if layout.total() > total:
            layout.set_out(poses)
    return layout


def fit(layout: Layout, number: int) -> float:
    """The share of its cells that a shape saves where it lies; of those that it must save where it is absent."""
    return _gain(layout, number) / layout.shapes[number].area


def _gain(layout: Layout, number: int) -> float:
    """What a shape saves where it lies; what it must save at least where it is absent."""
    if number not in layout.poses:
        return PRESENT * layout.shapes[number].area
    return layout.gain(number, layout.poses[number], layout.savings(number))


def _explain(layout: Layout, still: Sequence[int]) -> None:
    shapes = layout.shapes
    movable = [number for number in range(len(shapes)) if number not in still]
    orders = list(permutations(sorted(movable, key=lambda number: -shapes[number].area)))
    begun = []
    for order in orders[:: -(-len(orders) // ORDERS)]:
        layout.set_out({number: shapes[number].pose for number in still})
        for number in order:
            gain, pose = layout.search(number, layout.savings(number))
            layout.lay(number, pose if gain > PRESENT * shapes[number].area else None)
        begun.append((layout.total(), dict(layout.poses)))
    layout.set_out(min(begun, key=lambda one: one[0])[1])
    for _ in range(SWEEPS):
        improved = [_lay_anew(layout, number, number in still) for number in range(len(shapes))]
        if not any(improved) and not any([_exchange(layout, *pair) for pair in combinations(movable, 2)]):
            break
    for number, pose in list(layout.poses.items()):
        layout.lay(number, layout.refine(number, pose, layout.savings(number), *FINE)[1])


def _lay_anew(layout: Layout, number: int, still: bool) -> bool:
    """Lay a shape where it saves the most as the others lie; whether that is elsewhere."""
    table, former, least = layout.savings(number), _gain(layout, number), PRESENT * layout.shapes[number].area
    if still:
        gain, pose = layout.refine(number, layout.poses[number], table, *COARSE)
    else:
        gain, pose = layout.search(number, table)
    if max(gain, least) <= former + IMPROVEMENT:
        return False
    layout.lay(number, pose if gain > least or still else None)
    return True


def _exchange(layout: Layout, one: int, other: int) -> bool:
    """Lay two shapes each where the other lies, if that is better; whether it is."""
    poses, total = dict(layout.poses), layout.total()
    if one not in poses or other not in poses:
        return False
    layout.lay(one, None)
    layout.lay(other, None)
    for number, there in ((one, other), (other, one)):
        layout.lay(number, layout.search(number, layout.savings(number), near=poses[there])[1])
    if layout.total() < total - IMPROVEMENT:
        return True
    layout.set_out(poses)
    return False
