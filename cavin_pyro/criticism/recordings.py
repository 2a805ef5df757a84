"""New episodes, longer than those of a dataset, as states and pushes."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cavin_pyro.data.collection import CollectionConfig, collect_episode, open_scene
from cavin_pyro.data.features import cloud_features
from models.networks.geometry import Geometry
from models.state import State

SEED = 2**31  # added to a context's seed: datasets are collected with small ones, so no dataset has these episodes


class Recording(NamedTuple):
    """Episodes (E) of S pushes and the states between them, padded with the last observation."""

    states: State  # [E, S + 1]
    actions: Tensor  # [E, S, 4] normalised
    observed: Tensor  # [E, S + 1, M] bool: the episode has not ended, and the object is visible


def record(
    geometry: Geometry, world: CollectionConfig, *, episodes: int, steps: int, objects: int, seed: int
) -> Recording:
    """Simulate `episodes` of up to `steps` pushes with at most `objects` objects, by the policy that collects data."""
    config = replace(world, seed=SEED + seed, steps=steps, maximum_objects=objects)
    with closing(open_scene(config)) as scene:
        rows = [collect_episode(scene, config, number) for number in range(episodes)]
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    made = np.arange(steps + 1) <= arrays["length"][:, None]  # [E, S + 1]
    # A fall ends an episode, and what has fallen is no longer a state of the table.
    fallen = np.pad(arrays["fallen"], ((0, 0), (1, 0)))
    mask = np.broadcast_to(arrays["mask"][:, None], arrays["visible"].shape)
    observed = arrays["visible"] & mask & (made & ~fallen)[..., None]
    state = State(
        torch.from_numpy(arrays["centers"]),
        torch.from_numpy(cloud_features(geometry, arrays["clouds"])),
        torch.from_numpy(mask.copy()),
    )
    trimmed = State(state.centers[..., :objects, :], state.features[..., :objects, :], state.mask[..., :objects])
    return Recording(trimmed, torch.from_numpy(arrays["actions"]), torch.from_numpy(observed[..., :objects]))
