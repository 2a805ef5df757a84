"""Figures of a dataset: how far pushes move objects, and how many of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.data.dataset import Arrays, iterate_shards
from cavin_pyro.envs.tabletop.scene import MOVED
from cavin_pyro.envs.tabletop.workspace import OBJECT_SLOTS

SEGMENT = 3  # pushes; T of the paper
FLAGS = ("unsafe", "ineffective", "fallen")
ARRAYS = ("centers", "visible", "mask", "moved", "length", *FLAGS)


def summarize_data(folder: Path) -> dict[str, Any]:
    """Figures of all of a dataset; corrupt shards are named and left out.

    Returns:
        Numbers of `pushes` and `episodes`; shares of the pushes that were `unsafe`, `ineffective` or `fallen`, and that
        moved 0, 1, ... objects (`objects_moved`); medians in metres of how far the object went that went farthest, in a
        push and in any three in a row.

    Raises:
        UserError: no dataset, or none of its shards is whole.
    """
    parts, episodes = list[Arrays](), 0
    for _, arrays in iterate_shards(folder, ARRAYS, skip_corrupt=True):
        parts.append(of_pushes(arrays))
        episodes += len(arrays["length"])
    joined: dict[str, NDArray[Any]] = {name: np.concatenate([one[name] for one in parts]) for name in parts[0]}
    pushes = len(joined["farthest"])
    moved = np.bincount(joined["objects_moved"], minlength=OBJECT_SLOTS + 1)
    return {
        "pushes": pushes,
        "episodes": episodes,
        **{name: float(joined[name].mean()) for name in FLAGS},
        "objects_moved": (moved / pushes).tolist(),
        **{f"{name}_median": float(np.median(joined[name])) for name in ("farthest", "farthest_in_segment")},
    }


def of_pushes(arrays: Arrays) -> Arrays:
    """Of each push of a shard that was made, [n], the flags, metres of the `farthest` move and `objects_moved`.

    `farthest_in_segment`: [m] metres between the centres that the camera saw three pushes apart.
    """
    mask, centers = arrays["mask"][:, None], arrays["centers"].astype(np.float64)
    steps = np.arange(centers.shape[1])
    made = steps[:-1] < arrays["length"][:, None]  # [E, S]
    moved = np.where(mask, arrays["moved"], 0.0)  # [E, S, M]
    there = arrays["visible"] & mask & (steps <= arrays["length"][:, None])[..., None]  # [E, S+1, M]
    both = there[:, SEGMENT:] & there[:, :-SEGMENT]
    distance = np.linalg.norm(centers[:, SEGMENT:] - centers[:, :-SEGMENT], axis=-1)
    return {
        **{name: arrays[name][made] for name in FLAGS},
        "farthest": moved.max(axis=-1)[made],
        "objects_moved": (moved > MOVED).sum(axis=-1)[made],
        "farthest_in_segment": np.where(both, distance, 0.0).max(axis=-1)[both.any(axis=-1)],
    }
