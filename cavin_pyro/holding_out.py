"""Objects held out of training, so that a model can be tried on what it never saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.dataset import Arrays, read_metadata
from cavin_pyro.errors import UserError
from envs.object_asset import listed, plain_name


@dataclass(frozen=True)
class HeldOut:
    """Which objects of a dataset do not count, from whichever set they come.

    Attributes:
        numbers: of their shapes, as the dataset's arrays `shape` have them.
    """

    numbers: tuple[int, ...]

    @property
    def needs(self) -> tuple[str, ...]:
        """Arrays of a shard that tell where such objects lie; none if there is nothing to leave out."""
        return ("shape", "scale") if self.numbers else ()

    def lying(self, arrays: Arrays) -> NDArray[np.bool_]:
        """Which objects [E, M] of a shard's episodes are held out."""
        there = arrays["scale"] > 0.0  # padding has no size
        return np.isin(arrays["shape"], self.numbers) & there

    def without(self, arrays: Arrays) -> Arrays:
        """The episodes of a shard in which no such object lies on the table."""
        if not self.numbers:
            return arrays
        kept = ~self.lying(arrays).any(axis=-1)
        return {name: array[kept] for name, array in arrays.items()}


def hold_out(names: Sequence[str], folders: Sequence[Path], *, word: str) -> list[HeldOut]:
    """What each dataset knows under these names; `word` is where they were given.

    Raises:
        UserError: no dataset, or none has an object of such a name.
    """
    known = [read_metadata(folder).get("shape_names", []) if names else [] for folder in folders]
    every = dict.fromkeys(plain_name(name) for one in known for name in one)
    for name in names:
        if name not in every:
            where = " and ".join(map(str, folders))
            raise UserError(f"unknown object {name!r} in {word}: choose from {listed(every)}, which are in {where}")
    return [HeldOut(tuple(n for n, name in enumerate(one) if plain_name(name) in names)) for one in known]
