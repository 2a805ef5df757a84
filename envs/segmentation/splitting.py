"""Telling apart objects that touch, by the shapes that they had when they did not.

Each cell of a region is given to the object whose former shape, moved and turned over the table, explains it best:
iterated closest points (Besl and McKay 1992) for several shapes at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

ITERATIONS = 8
TURNS = np.radians([0.0, 30.0, -30.0])  # radians; of all shapes together, to begin with
HEIGHT_WEIGHT = 0.5  # metres across the table that a metre of height counts as
CAP = 0.03  # metres; no cell counts as farther from a shape

Points = NDArray[np.float64]
"""Cells as points: (x, y) metres and `HEIGHT_WEIGHT` times the height, each [C, 3]."""


@dataclass(frozen=True)
class Split:
    """Which shape each cell belongs to [C], and how badly the shapes explain the cells, metres."""

    owners: NDArray[np.intp]
    error: float


def split_by_shapes(cells: Points, shapes: Sequence[Points]) -> Split:
    """Give each of the cells [C, 3] to one of the shapes.

    Starts from the shapes where they were and from where they are if all were moved as their mean was, each also
    turned a little, and keeps the best.
    """
    shift = cells[:, :2].mean(axis=0) - np.concatenate(shapes)[:, :2].mean(axis=0)
    trees = [cKDTree(shape) for shape in shapes]
    starts = [[choice * shift for choice in choices] for choices in product((0.0, 1.0, 2.0), repeat=len(shapes))]
    if len(shapes) > 2:  # too many to try them all
        starts = [[np.zeros(2)] * len(shapes), [shift] * len(shapes)]
    found = [_align(cells, shapes, trees, start, turn) for start in starts for turn in TURNS]
    return min(found, key=lambda split: split.error)


def _align(
    cells: Points, shapes: Sequence[Points], trees: Sequence[cKDTree], start: Sequence[Points], turn: float
) -> Split:
    """Alternate between giving cells to shapes and moving the shapes onto their cells."""
    middles = [shape[:, :2].mean(axis=0) for shape in shapes]
    poses = [(_rotation(turn), middle + shift) for middle, shift in zip(middles, start, strict=True)]
    for _ in range(ITERATIONS):
        distances, partners = _closest(cells, trees, middles, poses)
        owners = distances.argmin(axis=0)
        for number, shape in enumerate(shapes):
            own = owners == number
            if own.sum() >= 3:
                poses[number] = _rigid(shape[partners[number, own], :2] - middles[number], cells[own, :2])
    distances, _ = _closest(cells, trees, middles, poses)
    owners = distances.argmin(axis=0)
    uncovered = []
    for number, shape in enumerate(shapes):
        own = cells[owners == number]
        if len(own) == 0:
            uncovered.append(CAP)
            continue
        rotation, position = poses[number]
        moved = np.column_stack(((shape[:, :2] - middles[number]) @ rotation.T + position, shape[:, 2]))
        uncovered.append(np.minimum(cKDTree(own).query(moved)[0], CAP).mean())
    return Split(owners, float(np.minimum(distances.min(axis=0), CAP).mean() + np.mean(uncovered)))


def _closest(
    cells: Points, trees: Sequence[cKDTree], middles: Sequence[Points], poses: Sequence[tuple[Points, Points]]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Distance [shapes, C] from each cell to each shape where it is now, and the number of the closest point."""
    found = []
    for tree, middle, (rotation, position) in zip(trees, middles, poses, strict=True):
        back = (cells[:, :2] - position) @ rotation + middle
        found.append(tree.query(np.column_stack((back, cells[:, 2]))))
    return np.stack([distance for distance, _ in found]), np.stack([partner for _, partner in found])


def _rigid(source: Points, goal: Points) -> tuple[Points, Points]:
    """Rotation and position that bring source [P, 2] closest to goal [P, 2] (Kabsch 1976, in the plane)."""
    source_middle, goal_middle = source.mean(axis=0), goal.mean(axis=0)
    (a, b), (c, d) = (source - source_middle).T @ (goal - goal_middle)
    rotation = _rotation(np.arctan2(b - c, a + d))
    return rotation, goal_middle - rotation @ source_middle


def _rotation(angle: float) -> Points:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
