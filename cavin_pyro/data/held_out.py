"""Objects held out of training, so that a model can be evaluated on unknown objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.config.errors import UserError
from cavin_pyro.data.dataset import Arrays, read_metadata
from envs.objects.object_sets import listed, plain_name


@dataclass(frozen=True)
class HeldOut:
    """The held-out objects of a dataset, from whichever set they come.

    Attributes:
        numbers: of their shapes, as the dataset's arrays `shape` have them.
    """

    numbers: tuple[int, ...]

    @property
    def required_arrays(self) -> tuple[str, ...]:
        """Arrays of a shard that are needed to find held-out objects; none if no object is held out."""
        return ("shape", "scale") if self.numbers else ()

    def held_out(self, arrays: Arrays) -> NDArray[np.bool_]:
        """Which objects [E, M] of a shard's episodes are held out."""
        there = arrays["scale"] > 0.0  # padding has no size
        return np.isin(arrays["shape"], self.numbers) & there

    def filter_episodes(self, arrays: Arrays) -> Arrays:
        """The episodes of a shard without any held-out object on the table."""
        if not self.numbers:
            return arrays
        kept = ~self.held_out(arrays).any(axis=-1)
        return {name: array[kept] for name, array in arrays.items()}


def find_held_out(names: Sequence[str], folders: Sequence[Path], *, option: str) -> list[HeldOut]:
    """The objects with these names, of each dataset; `option` is where the names were given.

    Raises:
        UserError: no dataset, or none has an object of such a name.
    """
    known = [read_metadata(folder).get("shape_names", []) if names else [] for folder in folders]
    every = dict.fromkeys(plain_name(name) for one in known for name in one)
    for name in names:
        if name not in every:
            where = " and ".join(map(str, folders))
            raise UserError(f"unknown object {name!r} in {option}: choose from {listed(every)}, which are in {where}")
    return [HeldOut(tuple(n for n, name in enumerate(one) if plain_name(name) in names)) for one in known]
