"""The search for windows in episodes: which are informative, which transitions count, which are held out."""

from __future__ import annotations

import math
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cavin_pyro.config.commands import WindowConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.data import dataset
from cavin_pyro.data.dataset import Arrays
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State


class WindowFinder:
    """Finds the windows in one shard after another, and holds no more of them than where they start."""

    def __init__(
        self,
        config: WindowConfig,
        segment_length: int,
        seed: int,
        where: str,
        slots: int,
        states: int,
        storage: Path | None,
        space: Space | None = None,
    ) -> None:
        """`slots`: M, that of the dataset with the most objects. `states`: how many there are at most.

        `space`: of the world; None of the tabletop.
        """
        self._config, self._length, self._seed, self._where = config, segment_length, seed, where
        self._space = space
        self._slots, self._states, self._storage = slots, states, storage
        self._turns = np.random.default_rng(seed)
        self._stored: Arrays = {}  # positions in time, episode after episode
        self._windows: dict[str, list[NDArray[Any]]] = {
            name: [] for name in ("starts", "sequence_mask", "episodes", "held_out")
        }
        self._episodes = self._filled = 0

    def add(self, episodes: Arrays, held_out: NDArray[np.bool_] | None = None) -> None:
        """Add the episodes of a shard; `held_out`: which are for validation, `[E]`, by default by their number.

        Raises UserError: they are too short, or not shaped as the metadata say.
        """
        T, config, positions = self._length, self._config, episodes["centers"].shape[1]
        if positions <= T:
            raise UserError(
                f"dataset {self._where} has {positions - 1} pushes per episode, too few for windows of "
                f"T={T}: collect with steps of at least that many"
            )
        episodes = dataset.padded(episodes, self._slots)
        mask, length = episodes["mask"], episodes["length"]
        made = np.arange(positions - 1)[None] < length[:, None]
        if self._space is None:
            visible: NDArray[np.bool_] = np.all(episodes["visible"] | ~mask[:, None], axis=-1)  # [E, S+1]
            counts = made & (_moves(episodes["centers"], mask, 1) < config.maximum_step)
            counts &= ~episodes["fallen"] & visible[:, :-1] & visible[:, 1:]
            moved = _moves(episodes["centers"], mask, T)
            flawed = episodes["unsafe"] | episodes["fallen"]
            informative = ~np.lib.stride_tricks.sliding_window_view(flawed, T, axis=1).any(axis=-1)
            informative &= visible[:, :-T] & visible[:, T:]
            informative &= (moved > config.minimum_move) & (moved < config.maximum_move)
        else:
            _check_units(episodes, self._space, self._where)
            counts = made
            informative = _moves(episodes["centers"], mask, T) > self._space.center_scale
            informative |= _moves(episodes["features"], mask, T) > self._space.feature_scale
        exists = np.arange(positions - T)[None] + T <= length[:, None]

        # The split depends on the episode's number alone, so more data does not change it.
        if held_out is None:
            numbers = [[self._seed, int(number)] for number in episodes["episode"]]
            shares = np.array([np.random.default_rng(number).random() for number in numbers])
            held_out = shares < config.validation_fraction
        validation = np.broadcast_to(held_out[:, None], exists.shape)
        chosen = exists & (informative | (self._turns.random(exists.shape) < config.negative_fraction))

        episode, start = np.nonzero(chosen)
        found = {"starts": self._filled + episode * positions + start, "sequence_mask": informative[chosen]}
        for name, values in {**found, "episodes": self._episodes + episode, "held_out": validation[chosen]}.items():
            self._windows[name].append(values)
        self._episodes += len(mask)
        self._store(
            centers=episodes["centers"],
            features=episodes["features"],
            mask=np.repeat(mask[:, None], positions, axis=1),
            actions=np.pad(episodes["actions"], ((0, 0), (0, 1), (0, 0))),
            counts=np.pad(counts, ((0, 0), (0, 1))),
        )

    def _store(self, **arrays: NDArray[Any]) -> None:
        """Append arrays [E, S+1, ...]."""
        filled = self._filled + arrays["mask"].shape[0] * arrays["mask"].shape[1]
        if filled > self._states:
            raise UserError(f"dataset {self._where} has more episodes than its metadata tell: collect it again")
        for name, array in arrays.items():
            rows = array.reshape(-1, *array.shape[2:])
            if name not in self._stored:
                self._stored[name] = _mapped(self._storage, (self._states, *rows.shape[1:]), rows.dtype)
            self._stored[name][self._filled : filled] = rows
        self._filled = filled

    def found(self) -> dict[str, Any]:
        """What `cavin_pyro.data.windows.WindowTable` is made of: all states and pushes, and the windows among them.

        Raises UserError: there is no window to train on, or none to validate with.
        """
        stored = {name: torch.from_numpy(array[: self._filled]) for name, array in self._stored.items()}
        windows = {name: torch.from_numpy(np.concatenate(parts)) for name, parts in self._windows.items()}
        for name, own in (("training", ~windows["held_out"]), ("validation", windows["held_out"])):
            if not windows["sequence_mask"][own].any():
                least = f"{self._config.minimum_move:g} m" if self._space is None else "the space's scales"
                raise UserError(
                    f"dataset {self._where} has no {name} window in which an object moved more than {least}: "
                    "collect more transitions"
                )
        states = State(stored["centers"], stored["features"], stored["mask"])
        made = {"states": states, "actions": stored["actions"], "transition_mask": stored["counts"]}
        return {**made, **windows, "segment_length": self._length}


def _mapped(folder: Path | None, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """An array in a temporary file, which need not fit in memory; without a name, so that it goes with the process."""
    with tempfile.TemporaryFile(dir=folder) as file:
        # A full disk is an error here; of a mapped file it would be a signal that ends the process.
        try:
            os.posix_fallocate(file.fileno(), 0, max(1, dtype.itemsize * math.prod(shape)))
        except OSError as error:
            error.filename = str(folder or tempfile.gettempdir())
            raise
        return np.memmap(file, dtype, mode="r+", shape=shape)


def _moves(values: NDArray[np.float32], mask: NDArray[np.bool_], steps: int) -> NDArray[np.float32]:
    """How far the object goes in some steps that goes farthest: `[E, S+1, M, ...]`, `[E, M]` -> `[E, S+1 - steps]`."""
    distance = np.linalg.norm(values[:, steps:] - values[:, :-steps], axis=-1)
    return np.where(mask[:, None], distance, 0.0).max(axis=-1)


def _check_units(episodes: Arrays, space: Space, where: str) -> None:
    """Raise a `UserError` for features whose first numbers are not of the length 1 that the space says."""
    steps = np.arange(episodes["features"].shape[1]) <= episodes["length"][:, None]  # [E, S+1]
    features = torch.from_numpy(episodes["features"][steps[..., None] & episodes["mask"][:, None]])
    if not torch.allclose(space.project(features), features, atol=1e-3):
        raise UserError(f"dataset {where} has features that are not of length 1, as the space's unit_features says")
