"""Avoidance of motions with a predicted failure (our addition to Algorithm 1, line 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning import returns
from cavin_pyro.planning.additions.addition import Addition, Choice, ChosenEffect
from cavin_pyro.planning.protocol import Query, Reward, SearchObjective, SegmentRollout, unwrap
from cavin_pyro.planning.returns import Progress, prefer

FAILURE = 1e3  # a squared distance, the cost of a predicted failure: more than any between states


@dataclass(frozen=True)
class FailureAvoidance(Addition):
    """Prefers motions along which f predicts no failure.

    If every motion fails in some segment, those that fail in the executed one rank last.
    """

    for_motions = True

    def wrap_objective(self, objective: SearchObjective, scene: Query, effect: ChosenEffect | None) -> SearchObjective:
        """See `Addition`; for motions only."""
        return objective if effect is None else AvoidFailures(objective, effect.segments, scene.reward)

    def rank(self, scores: Tensor, choice: Choice) -> Tensor:
        state = unwrap(choice.candidates.score_state, FailureState)
        # Without the cost of a failure, next to which distances lose their last digits.
        scores = torch.where(state.progress.failed & torch.isfinite(scores), state.inner.returns, scores)
        return prefer(prefer(scores, ~state.failed_in_executed), ~state.progress.failed)


class FailureState(NamedTuple):
    """The tracking cost of motion candidates, and their predicted failures; fields `[B, n]`."""

    inner: Any  # of the objective without failure avoidance
    progress: Progress
    failed_in_executed: Tensor  # bool: in the first segment, which is executed

    @property
    def returns(self) -> Tensor:
        """`[B, n]` minus the tracking cost; lower with a predicted failure, lowest with one in the executed segment."""
        return self.inner.returns - FAILURE * (self.progress.failed.int() + self.failed_in_executed.int())

    @property
    def failed(self) -> Tensor:
        return self.inner.failed

    @property
    def active(self) -> Tensor:
        return self.inner.active


class AvoidFailures(NamedTuple):
    """An objective that also checks f's predictions for failures, step by step."""

    objective: SearchObjective
    segments: Tensor  # [B] int64: segments until the effect plan ends; later failures do not count
    reward: Reward

    def start(self, plans: State) -> FailureState:
        progress = returns.start(plans.centers)
        return FailureState(self.objective.start(plans), progress, progress.failed)

    def advance(self, state: FailureState, segment: int, before: State, rollout: SegmentRollout) -> FailureState:
        inner = self.objective.advance(state.inner, segment, before, rollout)
        counts = (segment < self.segments).unsqueeze(-1)  # [B, 1]
        progress = state.progress._replace(succeeded=state.progress.succeeded | ~counts)  # later segments cannot fail
        start = before.values(self.reward.reads_features)
        progress = returns.advance(progress, self.reward, start, rollout.path, before.mask)
        executed = torch.as_tensor(segment == 0, device=counts.device)
        return FailureState(inner, progress, torch.where(executed, progress.failed, state.failed_in_executed))

    def early_stopped(self, state: FailureState) -> Tensor:
        return self.objective.early_stopped(state.inner)
