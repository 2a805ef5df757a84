"""Avoidance of motions with a predicted failure (our addition to Algorithm 1, line 10)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning import returns
from cavin_pyro.planning.protocol import Objective, RewardFunction, SegmentRollout
from cavin_pyro.planning.returns import Progress, prefer

FAILURE = 1e3  # square metres, the cost of a predicted failure: more than any distance on the table


class FailureState(NamedTuple):
    """The tracking cost of motion candidates, and their predicted failures; fields `[B, n]`."""

    tracking: Any  # `cavin_pyro.planning.cavin.TrackingState`
    progress: Progress
    failed_in_executed: Tensor  # bool: in the first segment, which is executed

    @property
    def returns(self) -> Tensor:
        """`[B, n]` minus the tracking cost; lower with a predicted failure, lowest with one in the executed segment."""
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
    """An objective that also checks f's predictions for failures, step by step."""

    objective: Objective  # `cavin_pyro.planning.cavin.TrackingCost`
    segments: Tensor  # [B] int64: segments until the effect plan ends; later failures do not count
    reward: RewardFunction

    def start(self, plans: State) -> FailureState:
        """The state of candidates without a segment, `plans: [B, n]`."""
        progress = returns.start(plans.centers)
        return FailureState(self.objective.start(plans), progress, progress.failed)

    def advance(self, state: FailureState, segment: int, before: State, rollout: SegmentRollout) -> FailureState:
        """The state after one more segment from `before: [B, n]`."""
        tracking = self.objective.advance(state.tracking, segment, before, rollout)
        counts = (segment < self.segments).unsqueeze(-1)  # [B, 1]
        progress = state.progress._replace(succeeded=state.progress.succeeded | ~counts)  # later segments cannot fail
        progress = returns.advance(progress, self.reward, before.centers, rollout.path, before.mask)
        executed = torch.as_tensor(segment == 0, device=counts.device)
        return FailureState(tracking, progress, torch.where(executed, progress.failed, state.failed_in_executed))

    def early_stopped(self, state: FailureState) -> Tensor:
        """As without failure avoidance."""
        return self.objective.early_stopped(state.tracking)


def prefer_no_failure(state: FailureState) -> tuple[Any, Tensor]:
    """The tracking state, and scores `[B, n]` that rank motions without a predicted failure first.

    If every motion fails in some segment, those that fail in the executed one rank last.
    """
    scores = prefer(state.tracking.returns, ~state.failed_in_executed)
    return state.tracking, prefer(scores, ~state.progress.failed)
