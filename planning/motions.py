"""Motion level: how to achieve it (paper, Algorithm 1, lines 8 to 10; section 3.2, "Motion-Level Plan")."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning import ranking, returns
from planning.candidates import Candidates
from planning.effects import EffectPlan
from planning.protocol import PlanningModel, RewardFunction
from planning.returns import Progress
from planning.robustness import Robustness, try_again
from planning.segments import Stretch, of_segment, pushes_of

FAILURE = 1e3  # square metres that a predicted failure costs an optimiser: more than any distance on the table


class Aim(NamedTuple):
    """How far sequences have kept from their subgoals; fields `[B, n]`."""

    distance: Tensor  # square metres, summed over the segments
    first_distance: Tensor  # of them, the executed segment's
    sound: Tensor  # bool: all actions finite
    failed_in_executed: Tensor  # bool
    progress: Progress

    @property
    def returns(self) -> Tensor:
        """`[B, n]` minus the distance, less where a failure is predicted, least where it is executed."""
        costs = self.distance + FAILURE * (self.progress.failed.int() + self.failed_in_executed.int())
        return torch.where(self.sound & torch.isfinite(costs), -costs, -torch.inf)

    @property
    def failed(self) -> Tensor:
        """`[B, n]` bool: none, for Algorithm 1 replaces no motions."""
        return torch.zeros_like(self.sound)

    @property
    def active(self) -> Tensor:
        """`[B, n]` bool: all, for line 9 predicts whole sequences."""
        return torch.ones_like(self.sound)


class Closeness(NamedTuple):
    """Scores sequences of motions by how close they lead to the chosen subgoals (line 10).

    Segments after the end of the chosen effect plan have nothing to aim at, and do not count. For the options see
    `planning.cavin.CavinPlanner`.
    """

    effects: EffectPlan
    reward: RewardFunction
    feature_weight: float
    avoid_failures: bool

    def start(self, plans: State) -> Aim:
        """Of sequences that have not begun, `plans: [B, n]`."""
        progress = returns.start(plans.centers)
        nothing = torch.zeros_like(progress.returns)
        return Aim(nothing, nothing, torch.ones_like(progress.failed), progress.failed, progress)

    def advance(self, standing: Aim, segment: int, before: State, stretch: Stretch) -> Aim:
        """After one more segment from `before: [B, n]`."""
        counts = (segment < self.effects.segments).unsqueeze(-1)  # [B, 1]
        executed = torch.as_tensor(segment == 0, device=counts.device)
        # Line 10: distance to the chosen subgoal, at the end of the segment.
        goal = self.effects.subgoals.map(lambda field: of_segment(field, segment))  # [B, 1, M, .]
        from_goal = ranking.squared_distance(stretch.states, goal, feature_weight=self.feature_weight)
        distance = standing.distance + torch.where(counts, from_goal, 0.0)
        assert stretch.actions is not None
        sound = standing.sound & (torch.isfinite(stretch.actions).all(-1).all(-1) | ~counts)
        progress, failed_in_executed = standing.progress, standing.failed_in_executed
        if self.avoid_failures:
            progress = progress._replace(succeeded=progress.succeeded | ~counts)  # nothing left to fail
            progress = returns.advance(progress, self.reward, before.centers, stretch.path, before.mask)
            failed_in_executed = torch.where(executed, progress.failed, failed_in_executed)
        first = torch.where(executed, distance, standing.first_distance)
        return Aim(distance, first, sound, failed_in_executed, progress)

    def settled(self, standing: Aim) -> Tensor:
        """`[B]` bool: nowhere, for no sequence ends before the others."""
        return torch.zeros_like(standing.sound[:, 0])


class MotionPlan(NamedTuple):
    """The chosen motion codes, their actions, and where f says that they lead; S segments of T steps."""

    codes: Tensor  # [B, S, Z] z*
    actions: Tensor  # [B, S T, 4] a*
    predicted_centers: Tensor  # [B, S T, M, 3] metres


def choose_motions(
    candidates: Candidates, model: PlanningModel, score: Closeness, robustness: Robustness | None
) -> MotionPlan:
    """Line 10: the sequence that comes closest to the subgoals (our addition: if it does not fail).

    Raises ValueError where no sequence of an environment leads to finite states.
    """
    aim = candidates.standing
    scores = torch.where(aim.sound, -aim.distance, -torch.inf)
    scores = ranking.prefer(scores, ~aim.failed_in_executed)
    scores = ranking.prefer(scores, ~aim.progress.failed)
    chosen = ranking.best(scores, "distances of motion plans to the subgoals")
    if robustness is not None:
        # Our addition: of the best, the one that still works where its pushes start a little elsewhere.
        chosen = try_again(
            robustness,
            model,
            score.reward,
            candidates.search.state,
            score.effects.subgoals.step(slice(0, 1)),
            scores,
            candidates.at(0, pushes_of),
            aim.distance - aim.first_distance,
            candidates.search.generators,
            feature_weight=score.feature_weight,
            engine=candidates.search.engine,
        )
    winner = candidates.take(chosen.unsqueeze(-1))
    return MotionPlan(
        codes=winner.history(lambda segment: segment.stretch.code)[:, 0],
        actions=winner.history(pushes_of)[:, 0].flatten(1, 2),
        predicted_centers=winner.history(lambda segment: segment.stretch.path)[:, 0].flatten(1, 2),
    )
