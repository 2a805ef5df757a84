"""The objects that a plan is about."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from cavin_pyro.models.state import State


class Focus(NamedTuple):
    """The objects that a plan is about, m of M."""

    indices: Tensor | None = None  # [B, m] int64, ascending; None for all objects

    def of(self, state: State) -> State:
        """These objects alone: `[B, ...]` of M objects -> `[B, ...]` of m."""
        if self.indices is None:
            return state
        indices = _along(self.indices, state)
        return State(
            state.centers.take_along_dim(indices, -2),
            state.features.take_along_dim(indices, -2),
            state.mask.take_along_dim(indices.squeeze(-1), -1),
        )

    def among(self, others: State, these: State) -> State:
        """States `these: [B, n]` of m objects, with all `others: [B]` of M where they are: `[B, n]` of M."""
        if self.indices is None:
            return these
        indices, everything = _along(self.indices, these), others.expand_plans(these.batch_shape[-1])
        return State(
            everything.centers.scatter(-2, indices.expand_as(these.centers), these.centers),
            everything.features.scatter(-2, indices.expand_as(these.features), these.features),
            everything.mask,
        )


def _along(indices: Tensor, state: State) -> Tensor:
    """`indices: [B, m]` of objects, to index the fields of `state: [B, ...]`: `[B, 1 ..., m, 1]`."""
    return indices.reshape(len(indices), *(1,) * (len(state.batch_shape) - 1), -1, 1)
