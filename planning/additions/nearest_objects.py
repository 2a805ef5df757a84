"""Plans about the target and the objects nearest to it (our addition to Algorithm 1, line 5)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning.protocol import RewardFunction, goal_objects


class NearestObjects(NamedTuple):
    """The target and the m - 1 objects nearest to it, of M.

    h, g and the priors read and move only these, so they read no more objects than in training. f still predicts all M,
    because an excluded object can obstruct a push.
    """

    indices: Tensor | None = None  # [B, m] int64, ascending: the target, object 0, comes first; None for all objects

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


def nearest_objects(state: State, most: int | None, reward: RewardFunction) -> NearestObjects:
    """The target and the objects nearest to it, `most` in all.

    All objects in scenes `state: [B]` of up to `most`, and for tasks whose goal is about every object.
    """
    if most is None or state.objects <= most or goal_objects(reward) != "target":
        return NearestObjects()
    distances = (state.centers[..., :2] - state.centers[:, :1, :2]).norm(dim=-1)  # [B, M] metres
    distances = torch.where(state.mask, distances, torch.inf)
    return NearestObjects(distances.topk(most, largest=False).indices.sort(-1).values)
