"""No push that would touch down on an object (our addition to Algorithm 1, line 10, and to the baselines).

f reads an object's centre and feature only, and the search exploits its errors; the observed points show where it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cavin_pyro.planning.additions.addition import Addition, Choice
from cavin_pyro.planning.checks import check_weight
from cavin_pyro.planning.returns import prefer


@dataclass(frozen=True)
class Touchdown(Addition):
    """Leaves out candidates whose first push starts nearer than `distance` metres to a point that the camera sees.

    As far as the caller gives such points, `observed: ObservedPoints`. If no candidate would be left, all stay. The
    baselines' searches may have stopped early, so the scores of their other candidates are partial.

    Raises ValueError for a distance that is negative or not finite.
    """

    distance: float = 0.015

    def __post_init__(self) -> None:
        check_weight("distance", self.distance)

    def rank(self, scores: Tensor, choice: Choice) -> Tensor:
        observed = choice.scene.observed
        if not isinstance(observed, ObservedPoints) or observed.points.shape[1] == 0:
            return scores
        return self.leave_out(scores, choice.first_actions()[..., 0, :], observed)

    def leave_out(self, scores: Tensor, pushes: Tensor, observed: ObservedPoints) -> Tensor:
        """Scores `[B, N]` without candidates whose first push, of `pushes: [B, N, 4]`, touches down on a point."""
        return prefer(scores, ~observed.blocked(pushes, self.distance))


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
