"""Choice among candidates, per environment."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning.inputs import NoFiniteCandidateError


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
    """How far a segment is from its subgoal: a terminal cost, and a running cost (Algorithm 1, line 10).

    feature_weight: as in `squared_distance`. running_cost_share: in [0, 1], of the squared distance of centres after
    the earlier steps, their mean; the rest is the distance at the end, which counts alone with 0 (paper).
    """

    feature_weight: float = 0.0
    running_cost_share: float = 0.0

    def __call__(self, end: State, path: Tensor, subgoal: State) -> Tensor:
        """`[...]` square metres, from the last state `end: [...]` and the centres `path: [..., T, M, 3]` metres.

        Their leading dimensions and those of `subgoal: [...]` broadcast.
        """
        terminal = squared_distance(end, subgoal, feature_weight=self.feature_weight)
        if not self.running_cost_share or path.shape[-3] == 1:
            return terminal
        earlier = (path[..., :-1, :, :] - subgoal.centers.unsqueeze(-3)).square().sum(-1)
        running = torch.where(subgoal.mask.unsqueeze(-2), earlier, 0.0).sum(-1).mean(-1)
        return torch.lerp(terminal, running, self.running_cost_share)


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
