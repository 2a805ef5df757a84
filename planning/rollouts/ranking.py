"""Choice among candidates, per environment."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning.inputs import NoFiniteCandidateError

AUTO, END, FIRST_PUSH = "auto", "end", "first_push"  # where motions are compared with a subgoal


def squared_distance(states: State, goals: State, *, feature_weight: float = 0.0) -> Tensor:
    """Sum over real objects of the squared distance to their goals: `[...]` square metres.

    `states`, `goals`: `[...]`, whose leading dimensions broadcast; the mask is the goals'. `feature_weight`:
    square metres per squared unit of distance between features; 0 ignores features.
    """
    per_object = (states.centers - goals.centers).square().sum(-1)
    if feature_weight:
        per_object = per_object + feature_weight * (states.features - goals.features).square().sum(-1)
    return torch.where(goals.mask, per_object, 0.0).sum(-1)


class SubgoalDistance(NamedTuple):
    """How far a segment is from its subgoal (Algorithm 1, line 10).

    feature_weight: as in `squared_distance`, of the features at the end of what is rolled out. at: where centres are
    compared, at the `end` of the segment (paper) or after its `first_push`.
    """

    feature_weight: float = 0.0
    at: str = END

    def pushes(self, segment_length: int) -> int:
        """After how many of a segment's T pushes centres are compared."""
        return segment_length if self.at == END else 1

    def __call__(self, end: State, path: Tensor, subgoal: State) -> Tensor:
        """`[...]` square metres, from the last state `end: [...]` and the centres `path: [..., T, M, 3]` metres.

        Their leading dimensions and those of `subgoal: [...]` broadcast.
        """
        compared = end if self.at == END else end._replace(centers=path[..., 0, :, :])
        return squared_distance(compared, subgoal, feature_weight=self.feature_weight)


def prefer(scores: Tensor, preferred: Tensor) -> Tensor:
    """Scores `[B, N]` with -inf for candidates outside `preferred: [B, N]`, in environments with a preferred one.

    A preferred candidate without a finite score does not count.
    """
    preferred = preferred & torch.isfinite(scores)
    return torch.where(preferred | ~preferred.any(-1, keepdim=True), scores, -torch.inf)


def best_of(scores: Tensor, what: str) -> Tensor:
    """Number of the plan with the highest score, the first among equals: `[B]` int64, from `scores: [B, N]`.

    Scores that are not finite lose. Raises ValueError with the environment and `what` was ranked if none is finite:
    no plan from such a choice may reach a robot.
    """
    finite = torch.isfinite(scores)
    infinite = (~finite.any(-1)).nonzero().flatten().tolist()
    if infinite:
        raise NoFiniteCandidateError(
            infinite[0],
            f"none of the {scores.shape[-1]} {what} is finite; "
            "check the observed state, the reward and the model's weights",
        )
    return torch.where(finite, scores, -torch.inf).argmax(-1)
