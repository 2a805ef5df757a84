"""Registration of objects in contact, by their shapes from when they stood alone.

Analysis by synthesis: place the shapes on the height map so that together they explain it at the lowest cost, without
overlaps. The search places one shape after the other where it lowers the cost most, in several orders; then it removes
and places each one again until the cost stops falling (block coordinate descent, each step a search over all poses),
and exchanges pairs of similar shapes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from envs.segmentation.arrangement import FINE, PRESENT, Arrangement
from envs.segmentation.shapes import Shape

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
