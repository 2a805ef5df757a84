"""Windows for training from episodes on disk: selection, split, and batches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Sized
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from cavin_pyro.config.commands import WindowConfig
from cavin_pyro.config.device import send
from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.options import MAXIMUM_SEED
from cavin_pyro.data import dataset
from cavin_pyro.data.dataset import Arrays
from cavin_pyro.data.episodes import checked_episode, packed
from cavin_pyro.data.features import find_held_out, geometry_fingerprint, held_out, shard_features
from cavin_pyro.data.finding import WindowFinder
from cavin_pyro.models.checks import check_number, typed
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State, Window
from cavin_pyro.storage.digests import tensors_digest
from cavin_pyro.storage.progress import progress_bar

SEGMENT_LENGTH = 3  # T
NEEDED = ("centers", "visible", "mask", "actions", "unsafe", "fallen", "length", "shape", "scale")  # of a shard


class WindowTable:
    """All states and pushes of a dataset, and where its windows start.

    Batches gather windows on demand, so overlapping windows share their memory. States and pushes may be memory maps of
    a file (`load_windows`); about 35 bytes for each window are held in memory.

    Windows are chosen on the CPU, so that one seed chooses the same ones for every device (`move`).

    Attributes:
        training, validation: indices of windows, for `batch`. episodes: the episode that each window is from.
        device: of batches. geometry: the fingerprint of what made the features; None if it is not known.
        selection: of a dataset's, `windows` and the seed of the `split`, by which `check` finds the same ones.
    """

    geometry: str | None = None
    selection: Mapping[str, Any] = {}

    def __init__(
        self,
        states: State,
        actions: Tensor,
        transition_mask: Tensor,
        *,
        starts: Tensor,
        sequence_mask: Tensor,
        episodes: Tensor,
        held_out: Tensor,
        segment_length: int = SEGMENT_LENGTH,
    ) -> None:
        """W windows of P positions in time, which are stored episode after episode.

        Args:
            states, actions, transition_mask: `[P, ...]`.
            starts: position of each window's first state, `[W]`. sequence_mask, episodes: `[W]`.
            held_out: which windows are for validation, `[W]` bool.
            segment_length: T.
        """
        self._states, self._actions, self._transition_mask = states, actions, transition_mask
        self.device = torch.device("cpu")
        self._steps = torch.arange(segment_length + 1)
        self.starts, self.sequence_mask, self.episodes = starts, sequence_mask, episodes
        self.training, self.validation = (~held_out).nonzero()[:, 0], held_out.nonzero()[:, 0]
        # Objects up to the last real one, at each position; piece by piece, since the states may be larger than memory.
        slots = torch.arange(1, states.objects + 1, dtype=torch.uint8)
        self._objects = torch.cat([(part * slots).amax(-1) for part in states.mask.split(2**16)])

    @classmethod
    def from_episodes(
        cls,
        space: Space,
        *,
        centers: Sequence[ArrayLike],
        features: Sequence[ArrayLike],
        actions: Sequence[ArrayLike],
        mask: Sequence[ArrayLike] | None = None,
        segment_length: int = SEGMENT_LENGTH,
        negative_fraction: float = WindowConfig.negative_fraction,
        validation_fraction: float = WindowConfig.validation_fraction,
        seed: int = 0,
    ) -> WindowTable:
        """All windows of episodes of one's own, such as lists of arrays, chosen and split as those of a dataset.

        windows = WindowTable.from_episodes(world.space, centers=centers, features=features, actions=actions)

        Args:
            space: of the world.
            centers, features, actions: of each episode of S steps, `[S + 1, M, P]`, `[S + 1, M, F]`, and `[S, A]` from
                -1 to 1. mask: real objects, `[M]` of each; by default all.
            segment_length: T. negative_fraction: share that is kept of windows in which nothing moves.
            validation_fraction: share of the episodes, at least one, that is for validation, which `seed` chooses.

        Raises UserError: shapes that do not fit, numbers that are not finite, an action out of its box, or no window.
        """
        with user_input():
            check_number("segment_length", segment_length, 1, whole=True)
            check_number("negative_fraction", negative_fraction, high=1)
            check_number("validation_fraction", validation_fraction, high=0.99, positive=True)
            check_number("seed", seed, high=MAXIMUM_SEED, whole=True)
            parts: list[Any] = [centers, features, actions, *([] if mask is None else [mask])]
            counts = [str(len(part)) if isinstance(part, Sized) else type(part).__name__ for part in parts]
            if not isinstance(space, Space) or len({*counts}) > 1 or not counts[0].isdecimal():
                given = f"{type(space).__name__} and {', '.join(counts)}"
                raise UserError(f"give a Space, and as many centers, features, actions and masks in lists, not {given}")
            episodes: list[Arrays] = []
            sizes: dict[str, int] = {}  # of the first
            for number, one in enumerate(zip(*parts, strict=True)):
                with user_input(where=f"episode {number}"):
                    episodes.append(checked_episode(space, *one, **sizes))
                M, F = episodes[0]["features"].shape[1:]
                sizes = {"objects": M, "feature_dimension": F}
            longest = max((len(one["actions"]) for one in episodes), default=0)
            if len(episodes) < 2:
                raise UserError(f"{len(episodes)} episodes: give at least two, since one is for validation")
            count = min(max(1, round(validation_fraction * len(episodes))), len(episodes) - 1)
            order = torch.randperm(len(episodes), generator=torch.Generator().manual_seed(seed))
            held = np.isin(np.arange(len(episodes)), order[:count].numpy())
            together = packed(episodes, range(len(episodes)), longest)
        config = WindowConfig(negative_fraction=negative_fraction)
        states, slots = len(episodes) * (longest + 1), together["mask"].shape[1]
        found = WindowFinder(config, segment_length, seed, "of these episodes", slots, states, None, space)
        found.add(together, held)
        return cls(**found.found())

    @property
    def objects(self) -> int:
        """The most objects of any state."""
        return int(self._objects.max())

    def content_record(self) -> dict[str, Any]:
        """Size and digest of what is in it, by which a training knows its data again."""
        tables = {**self._states._asdict(), "actions": self._actions, "transition_mask": self._transition_mask}
        tables |= {"starts": self.starts, "sequence_mask": self.sequence_mask, "training": self.training}
        return {"transitions": int(self._transition_mask.sum()), "fingerprint": tensors_digest(tables)}

    def move(self, device: torch.device, room: int) -> bool:
        """Give batches on a device; also keep states and pushes there if they take at most `room` bytes.

        Returns whether they are kept there. If not, each batch is gathered on the CPU and copied.
        """
        tables = (*self._states, self._actions, self._transition_mask)
        self.device = device
        if sum(table.nbytes for table in tables) > room:
            return False
        self._states = self._states.map(lambda field: field.to(device))
        self._actions, self._transition_mask = self._actions.to(device), self._transition_mask.to(device)
        return True

    @cached_property
    def _by_object_count(self) -> dict[int, Tensor]:
        """Training windows by their number of objects."""
        objects = self._objects[self.starts[self.training]]
        return {int(count): self.training[objects == count] for count in objects.unique()}

    def sample(self, count: int, generator: torch.Generator, *, bucketed: bool = False) -> Tensor:
        """Indices [count] int64 of training windows, sampled with replacement.

        `bucketed`: windows with the same number of objects as one that is sampled first. Every window is equally
        likely, and a batch needs no padding, which is most of the work for small numbers of objects.
        """
        indices = self.training
        if bucketed:
            first = indices[torch.randint(len(indices), (1,), generator=generator)]
            indices = self._by_object_count[int(self._objects[self.starts[first]])]
        return indices[torch.randint(len(indices), (count,), generator=generator)]

    @typed(ValueError)
    def batch(self, indices: Tensor) -> Window:
        """The windows `indices: [B]` int64, on the CPU, without padding that none of them needs, on `device`.

        Raises ValueError: there are none, or no windows of these numbers.
        """
        low, high = indices.aminmax() if indices.dtype == torch.int64 and indices.numel() else (-1, -1)
        if not 0 <= int(low) <= int(high) < len(self.starts):
            raise ValueError(f"a batch needs whole numbers of windows, 0 to {len(self.starts) - 1}, at least one")
        positions = self.starts[indices, None] + self._steps
        objects = int(self._objects[positions].max())
        positions = send(positions, self._actions.device)
        window = Window(
            states=self._states.map(lambda field: field[:, :objects][positions]),
            actions=self._actions[positions[:, :-1]],
            transition_mask=self._transition_mask[positions[:, :-1]],
            sequence_mask=self.sequence_mask[indices],
        )
        return window.map(lambda field: send(field, self.device))


@typed(UserError)
def load_windows(
    folders: Sequence[Path],
    geometry: Geometry | None,
    config: WindowConfig | None = None,
    *,
    segment_length: int = SEGMENT_LENGTH,
    seed: int = 0,
    storage: Path | None = None,
) -> WindowTable:
    """Read one or more datasets, compute missing features, and find the windows.

    Args:
        geometry: of features; None for datasets of other worlds than the tabletop, which have their own.
        segment_length: T. seed: of the split into training and validation.
        storage: folder for a temporary file with all states, which need not fit in memory; by default the system's.

    Raises UserError: no dataset, a corrupt shard, incompatible datasets, or no window to train on.
    """
    config = config or WindowConfig()
    if not folders:
        raise UserError("there are no folders to read: give at least one")
    every = [dataset.read_metadata(folder) for folder in folders]
    space = shared_space(folders)
    if geometry is None and space is None:
        raise UserError("datasets of the tabletop need a geometry, which makes features of their clouds")
    if geometry is not None:
        dataset.check_tabletop(folders, f"there are no clouds in it for {type(geometry).__name__}")
    for name in ("maximum_step", "minimum_move", "maximum_move") if space else ():
        if getattr(config, name) != getattr(WindowConfig, name):
            raise UserError(f"windows.{name} is of the tabletop; elsewhere the space's scales say what moves: leave it")
    if config.minimum_move >= config.maximum_move:
        raise UserError(f"windows.minimum_move must be below windows.maximum_move={config.maximum_move:g}")
    fingerprint = "" if geometry is None else geometry_fingerprint(geometry)
    dataset.check_distinct(folders)
    excluded = find_held_out(config.held_out_objects, folders, option="windows.held_out_objects")
    where = " and ".join(map(str, folders))
    states = sum(metadata["episodes"] * (metadata["configuration"]["steps"] + 1) for metadata in every)
    found = WindowFinder(config, segment_length, seed, where, max(map(dataset.slots_of, every)), states, storage, space)
    names = NEEDED if space is None else tuple(dataset.WORLD_ARRAYS)
    with progress_bar("reading", total=sum(metadata["shards"] for metadata in every), unit="file") as bar:
        for folder, numbers, metadata in zip(folders, excluded, every, strict=True):
            made = 0
            for number, arrays in dataset.iterate_shards(folder, names):
                bar.update()
                made += int(arrays["length"].sum())
                if geometry is not None:
                    arrays["features"] = shard_features(folder, number, geometry, fingerprint)
                    kept = ~held_out(arrays, numbers).any(axis=-1)
                    arrays = {name: array[kept] for name, array in arrays.items()}
                found.add(arrays)
            if made != metadata["transitions"]:
                said = f"{made} transitions, and its metadata say {metadata['transitions']}"
                raise UserError(f"{folder} has {said}: collect it again")
    table = WindowTable(**found.found())
    table.geometry, table.selection = fingerprint or None, {"windows": asdict(config), "split": seed}
    return table


def shared_space(folders: Sequence[Path]) -> Space | None:
    """The space of the world that all datasets are of; None for the tabletop.

    Raises UserError: no dataset, or they are of different worlds.
    """
    every = [dataset.read_metadata(folder) for folder in folders]
    for name in ("world", "space", "objects", "features"):
        first, *others = (one["configuration"].get(name) for one in every)
        for folder, other in zip(folders[1:], others, strict=True):
            if other != first:
                raise UserError(
                    f"{folders[0]} and {folder} are not of the same world ({name} is {first} and {other}): "
                    "train on datasets of one world"
                )
    return dataset.space_of(every[0])
