"""Matching of moved objects with pieces of the map, and with parts of a piece of several objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from envs.segmentation.height_map import CELL, HeightMap, Mask
from envs.segmentation.regions import AROUND, MINIMUM_AREA, box_around
from envs.segmentation.registration import explain
from envs.segmentation.shapes import Shape, shape_of

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
            found[number] = Match(region, arrangement.placed(index).shifted(row, column) if fits else None)
    return found | _left_over({n: shape for n, shape in moved.items() if n not in found}, found, concerned, heights)


def _left_over(
    absent: Mapping[int, Shape], found: Mapping[int, Match], concerned: Mask, heights: HeightMap
) -> dict[int, Match]:
    """Objects among the `concerned` cells [I, J] that no shape explains: such an object shows another side."""
    if not absent:
        return {}
    explained = np.any([one.region for one in found.values()] or [np.zeros_like(concerned)], axis=0)
    labels, count = ndimage.label(concerned & ~ndimage.binary_dilation(explained, AROUND), AROUND)
    pieces = [labels == 1 + number for number in range(count)]
    pieces = [piece for piece in pieces if piece.sum() * CELL**2 >= MINIMUM_AREA]
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
