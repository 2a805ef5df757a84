"""Windows for training from episodes on disk: selection, split, and batches."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.config.commands.training import WindowConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.data.dataset import Arrays, EpisodeNumbers, check_distinct, iterate_shards, read_metadata
from cavin_pyro.data.features import geometry_fingerprint, shard_features
from cavin_pyro.data.held_out import find_held_out
from cavin_pyro.storage.progress import progress_bar
from models.networks.geometry import Geometry
from models.state import State, Window

SEGMENT_LENGTH = 3  # T


class WindowTable:
    """All states and pushes of a dataset, and where its windows start.

    Batches gather windows on demand, so overlapping windows share their memory.

    Attributes:
        training, validation: numbers of windows, for `batch`. episodes: the episode that each window is from.
    """

    def __init__(
        self, states: State, actions: Tensor, transition_mask: Tensor, segment_length: int = SEGMENT_LENGTH
    ) -> None:
        """States, actions and transition_mask have leading dimension [P], positions in time, episode after episode."""
        self._states, self._actions, self._transition_mask = states, actions, transition_mask
        self._steps = torch.arange(segment_length + 1)
        self.starts = torch.empty(0, dtype=torch.int64)
        self.sequence_mask = torch.empty(0, dtype=torch.bool)
        self.episodes = torch.empty(0, dtype=torch.int64)
        self.training = torch.empty(0, dtype=torch.int64)
        self.validation = torch.empty(0, dtype=torch.int64)
        # Objects up to the last real one, at each position.
        self._objects = (states.mask * torch.arange(1, states.objects + 1)).amax(-1)

    @cached_property
    def _by_object_count(self) -> dict[int, Tensor]:
        """Training windows by their number of objects."""
        objects = self._objects[self.starts[self.training]]
        return {int(count): self.training[objects == count] for count in objects.unique()}

    def sample(self, count: int, generator: torch.Generator, *, bucketed: bool = False) -> Tensor:
        """Numbers [count] of training windows, sampled with replacement.

        `bucketed`: windows with the same number of objects as one that is sampled first. Every window is equally
        likely, and a batch needs no padding, which is most of the work for small numbers of objects.
        """
        numbers = self.training
        if bucketed:
            first = numbers[torch.randint(len(numbers), (1,), generator=generator)]
            numbers = self._by_object_count[int(self._objects[self.starts[first]])]
        return numbers[torch.randint(len(numbers), (count,), generator=generator)]

    def batch(self, numbers: Tensor) -> Window:
        """The windows with these numbers [B], without padding that none of them needs."""
        positions = self.starts[numbers, None] + self._steps
        objects = int(self._objects[positions].max())
        return Window(
            states=self._states.map(lambda field: field[:, :objects][positions]),
            actions=self._actions[positions[:, :-1]],
            transition_mask=self._transition_mask[positions[:, :-1]],
            sequence_mask=self.sequence_mask[numbers],
        )


def load_windows(
    folders: Sequence[Path],
    geometry: Geometry,
    config: WindowConfig | None = None,
    *,
    segment_length: int = SEGMENT_LENGTH,
    seed: int = 0,
    skip_corrupt: bool = False,
) -> WindowTable:
    """Read one or more datasets, compute missing features, and find the windows.

    Args:
        segment_length: T. seed: of the split into training and validation.

    Raises:
        UserError: no dataset, a corrupt shard, incompatible datasets, or no window to train on.
    """
    config = config or WindowConfig()
    fingerprint, shards = geometry_fingerprint(geometry), []
    lengths = {folder: read_metadata(folder)["configuration"]["steps"] for folder in folders}
    if len(set(lengths.values())) > 1:
        raise UserError(
            "datasets with episodes of different length cannot be joined: "
            + ", ".join(f"{folder} has steps={steps}" for folder, steps in lengths.items())
        )
    check_distinct(folders)
    names: tuple[str, ...] = ("centers", "visible", "mask", "actions", "unsafe", "fallen", "length", "episode")
    total = sum(read_metadata(folder)["shards"] for folder in folders)
    held_out_of = find_held_out(config.held_out_objects, folders, option="windows.held_out_objects")
    with progress_bar("reading", total=total, unit="file") as bar:
        for folder, held_out in zip(folders, held_out_of, strict=True):
            needed, known = (*names, *held_out.required_arrays), EpisodeNumbers(folder)
            for number, arrays in iterate_shards(folder, needed, skip_corrupt=skip_corrupt):
                known.add(number, arrays["episode"])
                arrays["features"] = shard_features(folder, number, geometry, fingerprint)
                shards.append(held_out.filter_episodes(arrays))
                bar.update()
    where = " and ".join(str(folder) for folder in folders)
    try:
        episodes = {name: np.concatenate([arrays[name] for arrays in shards]) for name in (*names, "features")}
    except ValueError as error:
        raise UserError(f"{where}: files with different numbers of objects cannot be joined ({error})") from error
    return _find_windows(episodes, config, segment_length, seed, where)


def _find_windows(episodes: Arrays, config: WindowConfig, segment_length: int, seed: int, folder: str) -> WindowTable:
    positions = episodes["visible"].shape[1]
    if segment_length >= positions:
        raise UserError(
            f"dataset {folder} has {positions - 1} pushes per episode, too few for windows of "
            f"T={segment_length}: collect with steps of at least that many"
        )
    mask, centers, length = episodes["mask"], episodes["centers"], episodes["length"]
    visible: NDArray[np.bool_] = np.all(episodes["visible"] | ~mask[:, None], axis=-1)  # [E, S+1]
    counts = _transitions_that_count(episodes, visible, config.maximum_step)

    T = segment_length
    first, last = slice(0, positions - T), slice(T, None)
    moved = np.where(mask[:, None], np.linalg.norm(centers[:, last] - centers[:, first], axis=-1), 0.0).max(axis=-1)
    flawed = episodes["unsafe"] | episodes["fallen"]
    safe = ~np.lib.stride_tricks.sliding_window_view(flawed, T, axis=1).any(axis=-1)
    informative = safe & visible[:, first] & visible[:, last]
    informative &= (moved > config.minimum_move) & (moved < config.maximum_move)
    exists = np.arange(positions - T)[None] + T <= length[:, None]

    # The split depends on the episode's number alone, so more data does not change it.
    shares = np.array([np.random.default_rng([seed, int(number)]).random() for number in episodes["episode"]])
    validation = np.broadcast_to((shares < config.validation_fraction)[:, None], exists.shape)
    turn = np.random.default_rng(seed).random(exists.shape)
    chosen = exists & (informative | (turn < config.negative_fraction))

    flat = {name: torch.from_numpy(episodes[name]).flatten(0, 1) for name in ("centers", "features")}
    padded = np.pad(episodes["actions"], ((0, 0), (0, 1), (0, 0)))
    states = State(flat["centers"], flat["features"], torch.from_numpy(np.repeat(mask, positions, axis=0)))
    table = WindowTable(
        states,
        torch.from_numpy(padded).flatten(0, 1),
        torch.from_numpy(np.pad(counts, ((0, 0), (0, 1)))).flatten(),
        segment_length,
    )
    episode, start = np.nonzero(chosen)
    table.starts = torch.from_numpy(episode * positions + start)
    table.sequence_mask = torch.from_numpy(informative[chosen])
    table.episodes = torch.from_numpy(episode)
    table.training = torch.from_numpy(np.flatnonzero(~validation[chosen]))
    table.validation = torch.from_numpy(np.flatnonzero(validation[chosen]))
    for name in ("training", "validation"):
        if not table.sequence_mask[getattr(table, name)].any():
            raise UserError(
                f"dataset {folder} has no {name} window in which an object moved more than "
                f"{config.minimum_move:g} m: collect more transitions"
            )
    return table


def _transitions_that_count(episodes: Arrays, visible: NDArray[np.bool_], maximum_step: float) -> NDArray[np.bool_]:
    """Which pushes [E, S] the dynamics f learns from."""
    step = np.linalg.norm(np.diff(episodes["centers"], axis=1), axis=-1)
    small = (np.where(episodes["mask"][:, None], step, 0.0) < maximum_step).all(axis=-1)
    made = np.arange(step.shape[1])[None] < episodes["length"][:, None]
    return made & small & ~episodes["fallen"] & visible[:, :-1] & visible[:, 1:]
