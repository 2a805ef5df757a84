"""No push that would touch down on an object (our addition to Algorithm 1, line 10, and to the baselines).

f reads an object's centre and feature only, and the search exploits its errors; the observed points show where it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from torch import Tensor

from cavin_pyro.models.checks import check_number
from cavin_pyro.planning.additions.addition import Addition, Choice
from cavin_pyro.planning.returns import prefer


@runtime_checkable
class Obstacles(Protocol):
    """What a world shows for `Touchdown`: `cavin_pyro.envs.world.World.observed`."""

    def blocked(self, actions: Tensor, distance: float) -> Tensor:
        """Which of `actions: [B, N, A]` begin nearer than `distance` to an object: `[B, N]` bool."""


@dataclass(frozen=True)
class Touchdown(Addition):
    """Leaves out candidates whose first push starts nearer than `distance` metres to a point that the camera sees.

    As far as the world shows `Obstacles`. If no candidate would be left, all stay. The baselines' searches may have
    stopped early, so the scores of their other candidates are partial.

    Raises ValueError for a distance that is negative or not finite.
    """

    distance: float = 0.015

    def __post_init__(self) -> None:
        check_number("distance", self.distance)

    def rank(self, scores: Tensor, choice: Choice) -> Tensor:
        observed = choice.scene.observed
        if not isinstance(observed, Obstacles):
            return scores
        return self.leave_out(scores, choice.first_actions()[..., 0, :], observed)

    def leave_out(self, scores: Tensor, pushes: Tensor, observed: Obstacles) -> Tensor:
        """Scores `[B, N]` without candidates whose first push, of `pushes: [B, N, 4]`, touches down on a point."""
        return prefer(scores, ~observed.blocked(pushes, self.distance))
