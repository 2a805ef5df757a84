"""From episodes on disk to windows for training: what counts, the split, and batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.dataset import Arrays, iterate_shards, read_metadata
from cavin_pyro.errors import UserError
from cavin_pyro.features import fingerprint, shard_features
from cavin_pyro.holding_out import hold_out
from cavin_pyro.progress import progress_bar
from models.pointnet import PointNet
from models.state import State, Window


@dataclass(frozen=True)
class WindowSettings:
    """Which windows and transitions teach what (the published implementation).

    Attributes:
        segment_length: T. validation_fraction: of the episodes. seed: of the split.
        maximum_step: metres; a transition counts for f if every object moved less.
        minimum_move, maximum_move: metres; a window counts for h and g if some object moved more than the first, none
            more than the second, and every push was safe.
        quiet_fraction: share of the other windows that is kept, for f to learn what pushes do not do.
        without: objects held out: no episode counts in which one of them lies on the table, from whichever set.
    """

    segment_length: int = 3
    validation_fraction: float = 0.1
    seed: int = 0
    maximum_step: float = 0.2
    minimum_move: float = 0.1
    maximum_move: float = 0.5
    quiet_fraction: float = 0.25
    without: tuple[str, ...] = ()


class WindowTable:
    """All states and pushes of a dataset, and where its windows start.

    A window is looked up when a batch needs it, so overlapping windows share their memory.

    Attributes:
        training, validation: numbers of windows, for `batch`.
    """

    def __init__(self, states: State, actions: Tensor, transition_mask: Tensor, settings: WindowSettings) -> None:
        """States, actions and transition_mask have leading dimension [P], positions in time, episode after episode."""
        self._states, self._actions, self._transition_mask = states, actions, transition_mask
        self._steps = torch.arange(settings.segment_length + 1)
        self.starts = torch.empty(0, dtype=torch.int64)
        self.sequence_mask = torch.empty(0, dtype=torch.bool)
        self.training = torch.empty(0, dtype=torch.int64)
        self.validation = torch.empty(0, dtype=torch.int64)
        # Objects up to the last real one, at each position.
        self._objects = (states.mask * torch.arange(1, states.objects + 1)).amax(-1)

    @cached_property
    def _alike(self) -> dict[int, Tensor]:
        """Training windows by their number of objects."""
        objects = self._objects[self.starts[self.training]]
        return {int(count): self.training[objects == count] for count in objects.unique()}

    def draw(self, count: int, generator: torch.Generator, *, alike: bool = False) -> Tensor:
        """Numbers [count] of training windows, drawn with replacement.

        `alike`: windows with the same number of objects as one that is drawn first. Every window is as likely as
        ever, and a batch needs no padding, which is most of the work for small numbers of objects.
        """
        numbers = self.training
        if alike:
            first = numbers[torch.randint(len(numbers), (1,), generator=generator)]
            numbers = self._alike[int(self._objects[self.starts[first]])]
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
    folders: Sequence[Path], pointnet: PointNet, settings: WindowSettings, *, skip_corrupt: bool = False
) -> WindowTable:
    """Read one or more datasets, compute the features that are not there yet, and find the windows.

    Raises:
        UserError: no dataset, a corrupt shard, datasets that do not go together, or no window to learn from.
    """
    mark, shards = fingerprint(pointnet), []
    lengths = {folder: read_metadata(folder)["settings"]["steps"] for folder in folders}
    if len(set(lengths.values())) > 1:
        raise UserError(
            "datasets with episodes of different length cannot be joined: "
            + ", ".join(f"{folder} has steps={steps}" for folder, steps in lengths.items())
        )
    names: tuple[str, ...] = ("centers", "visible", "mask", "actions", "unsafe", "fallen", "length", "episode")
    total = sum(read_metadata(folder)["shards"] for folder in folders)
    without = hold_out(settings.without, folders, word="windows.without")
    with progress_bar("reading", total=total, unit="file") as bar:
        for folder, held_out in zip(folders, without, strict=True):
            for number, arrays in iterate_shards(folder, (*names, *held_out.needs), skip_corrupt=skip_corrupt):
                arrays["features"] = shard_features(folder, number, pointnet, mark)
                shards.append(held_out.without(arrays))
                bar.update()
    episodes = {name: np.concatenate([arrays[name] for arrays in shards]) for name in (*names, "features")}
    return _find_windows(episodes, settings, " and ".join(str(folder) for folder in folders))


def _find_windows(episodes: Arrays, settings: WindowSettings, folder: str) -> WindowTable:
    positions = episodes["visible"].shape[1]
    if settings.segment_length >= positions:
        raise UserError(
            f"dataset {folder} has {positions - 1} pushes per episode, too few for windows of "
            f"T={settings.segment_length}: collect with steps of at least that many"
        )
    mask, centers, length = episodes["mask"], episodes["centers"], episodes["length"]
    seen: NDArray[np.bool_] = np.all(episodes["visible"] | ~mask[:, None], axis=-1)  # [E, S+1]
    counts = _transitions_that_count(episodes, seen, settings.maximum_step)

    T = settings.segment_length
    first, last = slice(0, positions - T), slice(T, None)
    moved = np.where(mask[:, None], np.linalg.norm(centers[:, last] - centers[:, first], axis=-1), 0.0).max(axis=-1)
    flawed = episodes["unsafe"] | episodes["fallen"]
    sound = ~np.lib.stride_tricks.sliding_window_view(flawed, T, axis=1).any(axis=-1)
    informative = sound & seen[:, first] & seen[:, last]
    informative &= (moved > settings.minimum_move) & (moved < settings.maximum_move)
    exists = np.arange(positions - T)[None] + T <= length[:, None]

    # The split hangs on an episode's own number, so that more data does not reshuffle what was held out before.
    draws = np.array([np.random.default_rng([settings.seed, int(number)]).random() for number in episodes["episode"]])
    validation = np.broadcast_to((draws < settings.validation_fraction)[:, None], exists.shape)
    turn = np.random.default_rng(settings.seed).random(exists.shape)
    chosen = exists & (informative | (turn < settings.quiet_fraction))

    flat = {name: torch.from_numpy(episodes[name]).flatten(0, 1) for name in ("centers", "features")}
    padded = np.pad(episodes["actions"], ((0, 0), (0, 1), (0, 0)))
    states = State(flat["centers"], flat["features"], torch.from_numpy(np.repeat(mask, positions, axis=0)))
    table = WindowTable(
        states,
        torch.from_numpy(padded).flatten(0, 1),
        torch.from_numpy(np.pad(counts, ((0, 0), (0, 1)))).flatten(),
        settings,
    )
    episode, start = np.nonzero(chosen)
    table.starts = torch.from_numpy(episode * positions + start)
    table.sequence_mask = torch.from_numpy(informative[chosen])
    table.training = torch.from_numpy(np.flatnonzero(~validation[chosen]))
    table.validation = torch.from_numpy(np.flatnonzero(validation[chosen]))
    for name in ("training", "validation"):
        if not table.sequence_mask[getattr(table, name)].any():
            raise UserError(
                f"dataset {folder} has no {name} window in which an object moved more than "
                f"{settings.minimum_move:g} m: collect more transitions"
            )
    return table


def _transitions_that_count(episodes: Arrays, seen: NDArray[np.bool_], maximum_step: float) -> NDArray[np.bool_]:
    """Which pushes [E, S] the dynamics f learns from."""
    step = np.linalg.norm(np.diff(episodes["centers"], axis=1), axis=-1)
    small = (np.where(episodes["mask"][:, None], step, 0.0) < maximum_step).all(axis=-1)
    made = np.arange(step.shape[1])[None] < episodes["length"][:, None]
    return made & small & ~episodes["fallen"] & seen[:, :-1] & seen[:, 1:]
