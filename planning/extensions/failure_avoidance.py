"""Motions along which f predicts no failure (our addition to Algorithm 1, line 10)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning.protocol import RewardFunction
from planning.rollouts import returns
from planning.rollouts.ranking import prefer
from planning.rollouts.returns import Progress
from planning.rollouts.segment import Objective, SegmentRollout

FAILURE = 1e3  # square metres that a predicted failure costs an optimizer: more than any distance on the table


class FailureState(NamedTuple):
    """The tracking cost of motion candidates, and their predicted failures; fields `[B, n]`."""

    tracking: Any  # `planning.cavin.TrackingState`
    progress: Progress
    failed_in_executed: Tensor  # bool: in the first segment, which is executed

    @property
    def returns(self) -> Tensor:
        """`[B, n]` minus the tracking cost, less where a failure is predicted, least where it is executed."""
        return self.tracking.returns - FAILURE * (self.progress.failed.int() + self.failed_in_executed.int())

    @property
    def failed(self) -> Tensor:
        """`[B, n]` bool: none, as without failure avoidance."""
        return self.tracking.failed

    @property
    def active(self) -> Tensor:
        """`[B, n]` bool: all, as without failure avoidance."""
        return self.tracking.active


class AvoidFailures(NamedTuple):
    """An objective that also judges, step by step, whether f predicts a failure."""

    objective: Objective  # `planning.cavin.TrackingCost`
    segments: Tensor  # [B] int64: segments until the effect plan ends; later failures do not count
    reward: RewardFunction

    def start(self, plans: State) -> FailureState:
        """Of candidates without a segment, `plans: [B, n]`."""
        progress = returns.start(plans.centers)
        return FailureState(self.objective.start(plans), progress, progress.failed)

    def advance(self, state: FailureState, segment: int, before: State, rollout: SegmentRollout) -> FailureState:
        """After one more segment from `before: [B, n]`."""
        tracking = self.objective.advance(state.tracking, segment, before, rollout)
        counts = (segment < self.segments).unsqueeze(-1)  # [B, 1]
        progress = state.progress._replace(succeeded=state.progress.succeeded | ~counts)  # nothing left to fail
        progress = returns.advance(progress, self.reward, before.centers, rollout.path, before.mask)
        executed = torch.as_tensor(segment == 0, device=counts.device)
        return FailureState(tracking, progress, torch.where(executed, progress.failed, state.failed_in_executed))

    def early_stopped(self, state: FailureState) -> Tensor:
        """As without failure avoidance."""
        return self.objective.early_stopped(state.tracking)


def prefer_no_failure(state: FailureState) -> tuple[Any, Tensor]:
    """The tracking state, and scores `[B, n]` by which motions without a predicted failure win.

    Where every motion fails in some segment, those that fail in the executed one lose against the others.
    """
    scores = prefer(state.tracking.returns, ~state.failed_in_executed)
    return state.tracking, prefer(scores, ~state.progress.failed)
