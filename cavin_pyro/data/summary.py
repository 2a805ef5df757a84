"""Counts over a dataset: how far pushes move objects, how many of them, and where on the table."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.data.dataset import Arrays, iterate_shards
from cavin_pyro.envs.tabletop.scene import MOVED
from cavin_pyro.envs.tabletop.workspace import OBJECT_SLOTS, TABLE_HIGH, TABLE_LOW, push_endpoints

SEGMENT = 3  # pushes; T of the paper
DISTANCES = np.linspace(0.0, 0.30, 61)  # metres, edges of the histograms; what is farther counts in the last bin
CELL = 0.02  # metres
CELLS = tuple(round((high - low) / CELL) for low, high in zip(TABLE_LOW, TABLE_HIGH, strict=True))
ARRAYS = ("centers", "visible", "mask", "actions", "moved", "unsafe", "ineffective", "fallen", "length")


@dataclass
class DataSummary:
    """Counts over a dataset's pushes.

    Attributes:
        pushes, unsafe, ineffective, fallen: how many pushes were made, and how many of these ended so.
        farthest: [60] pushes by how far the object went that went farthest; `farthest_in_segment`: the same of any
            three pushes in a row, between the centres that the camera saw.
        objects: [M + 1] episodes by how many objects lie on the table. objects_moved: [M + 1] pushes by how many moved.
        observed: [38, 61] observed centres of objects in each cell of the table, 2 cm wide, along x and y; pushed: of
            them, before a push that moved the object; started: pushes by where the tool came down.
    """

    pushes: int = 0
    unsafe: int = 0
    ineffective: int = 0
    fallen: int = 0
    farthest: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(DISTANCES) - 1, np.int64))
    farthest_in_segment: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(DISTANCES) - 1, np.int64))
    objects: NDArray[np.int64] = field(default_factory=lambda: np.zeros(OBJECT_SLOTS + 1, np.int64))
    objects_moved: NDArray[np.int64] = field(default_factory=lambda: np.zeros(OBJECT_SLOTS + 1, np.int64))
    observed: NDArray[np.int64] = field(default_factory=lambda: np.zeros(CELLS, np.int64))
    pushed: NDArray[np.int64] = field(default_factory=lambda: np.zeros(CELLS, np.int64))
    started: NDArray[np.int64] = field(default_factory=lambda: np.zeros(CELLS, np.int64))

    @property
    def episodes(self) -> int:
        """How many episodes were counted."""
        return int(self.objects.sum())

    def add(self, arrays: Arrays) -> None:
        """Count the episodes of one shard, arrays as in `cavin_pyro.data.dataset`."""
        mask, centers, visible = arrays["mask"], arrays["centers"].astype(np.float64), arrays["visible"]
        steps = np.arange(centers.shape[1])
        made = steps[None, :-1] < arrays["length"][:, None]  # [E, S]
        for name in ("unsafe", "ineffective", "fallen"):
            setattr(self, name, getattr(self, name) + int((arrays[name] & made).sum()))
        self.pushes += int(made.sum())

        moved = np.where(mask[:, None], arrays["moved"], 0.0)  # [E, S, M]
        self.farthest += _by_distance(moved.max(axis=-1)[made])
        slots = mask.shape[-1]
        self.objects_moved = _added(self.objects_moved, (moved > MOVED).sum(axis=-1)[made], slots)
        self.objects = _added(self.objects, mask.sum(axis=-1), slots)

        there = visible & mask[:, None] & (steps[None] <= arrays["length"][:, None])[..., None]  # [E, S+1, M]
        both = there[:, SEGMENT:] & there[:, :-SEGMENT]
        distance = np.linalg.norm(centers[:, SEGMENT:] - centers[:, :-SEGMENT], axis=-1)
        whole = both.any(axis=-1)
        self.farthest_in_segment += _by_distance(np.where(both, distance, 0.0).max(axis=-1)[whole])

        self.observed += _by_place(centers[there])
        self.pushed += _by_place(centers[:, :-1][there[:, :-1] & made[..., None] & (moved > MOVED)])
        self.started += _by_place(push_endpoints(arrays["actions"])[0][made])

    def figures(self) -> dict[str, Any]:
        """Shares of the pushes, medians in metres, and the share of the table's cells with at least ten of each."""
        pushes = max(self.pushes, 1)
        return {
            "pushes": self.pushes,
            "episodes": self.episodes,
            **{name: getattr(self, name) / pushes for name in ("unsafe", "ineffective", "fallen")},
            "objects_moved": (self.objects_moved / pushes).tolist(),
            "farthest_median": _median(self.farthest),
            "farthest_in_segment_median": _median(self.farthest_in_segment),
            "cells": {name: float((getattr(self, name) >= 10).mean()) for name in ("observed", "pushed", "started")},
        }


def summarize_data(folder: Path) -> DataSummary:
    """Count all of a dataset; corrupt shards are named and left out.

    Raises:
        UserError: no dataset, or none of its shards is whole.
    """
    summary = DataSummary()
    for _, arrays in iterate_shards(folder, ARRAYS, skip_corrupt=True):
        summary.add(arrays)
    return summary


def _added(counts: NDArray[np.int64], numbers: NDArray[np.int64], largest: int) -> NDArray[np.int64]:
    """Counts of the numbers 0 to `largest`, or to more if `counts` go farther, with these numbers."""
    size = max(len(counts), largest + 1)
    return np.pad(counts, (0, size - len(counts))) + np.bincount(numbers, minlength=size)


def _by_distance(distances: NDArray[np.floating]) -> NDArray[np.int64]:
    return np.histogram(np.minimum(distances, DISTANCES[-1]), DISTANCES)[0]


def _by_place(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """How many of the points [n, 2 or 3] metres lie in each cell of the table."""
    edges = [np.linspace(low, high, 1 + n) for low, high, n in zip(TABLE_LOW, TABLE_HIGH, CELLS, strict=True)]
    return np.histogram2d(points[:, 0], points[:, 1], edges)[0].astype(np.int64)


def _median(histogram: NDArray[np.int64]) -> float:
    """Metres, to the middle of a bin."""
    middle = int(np.searchsorted(histogram.cumsum(), histogram.sum() / 2))
    return float(DISTANCES[middle : middle + 2].mean())
