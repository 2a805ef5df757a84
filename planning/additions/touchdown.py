"""No push that would touch down on an object (our addition to Algorithm 1, line 10, and to the baselines).

A robot does not execute such a push. f's training data contain such failures, but f reads an object's centre and
feature only, and the search exploits its errors. The observed points show where the objects are.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cavin_pyro.planning.returns import prefer

TOUCHDOWN_DISTANCE = 0.015  # metres between a push's start and a point on which it would touch down


class ObservedPoints(NamedTuple):
    """Points of the objects that the camera sees, and the box that normalised starts of pushes span."""

    points: Tensor  # [B, P, 2] metres; infinite for no point
    low: Tensor  # [B, 2] metres, the start -1
    high: Tensor  # [B, 2] metres, the start 1

    def blocked(self, pushes: Tensor, distance: float) -> Tensor:
        """`[B, N]` bool: `pushes: [B, N, 4]` that start nearer than `distance` metres to a point."""
        low, high = self.low.unsqueeze(1), self.high.unsqueeze(1)
        starts = low + (pushes[..., :2].clamp(-1.0, 1.0) + 1.0) / 2.0 * (high - low)
        # Not by matrix products, in which an infinite point makes all distances NaN.
        apart = torch.cdist(starts, self.points, compute_mode="donot_use_mm_for_euclid_dist")
        return apart.amin(-1) < distance


def prefer_free(scores: Tensor, pushes: Tensor, observed: ObservedPoints | None, distance: float) -> Tensor:
    """Scores `[B, N]` that leave out candidates whose first push would touch down on an object.

    pushes: `[B, N, 4]`, the first of each candidate. observed: None where nothing is known. distance: metres between
    the push's start and a point; 0 leaves out none. If none would be left, the scores stay as they are. The
    baselines' searches may have stopped early, so the scores of their other candidates are partial.
    """
    if observed is None or not distance or observed.points.shape[1] == 0:
        return scores
    return prefer(scores, ~observed.blocked(pushes, distance))
