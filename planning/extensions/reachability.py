"""Reachable effects (our addition to Algorithm 1, line 7)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from models.state import State
from planning.inputs import check_positive
from planning.protocol import PlanningModel, RewardFunction
from planning.rollouts import returns
from planning.rollouts.candidates import Candidates, SearchProblem
from planning.rollouts.dynamics import predict_states
from planning.rollouts.ranking import best_of, prefer, squared_distance
from planning.rollouts.sampling import sample_each
from planning.rollouts.segment import SegmentRollout

PredictEffect = Callable[[State, State, Tensor], SegmentRollout]  # `planning.cavin.EffectSpace.predict`


@dataclass(frozen=True)
class Reachability:
    """Rescores the best effect plans with f's prediction of their first segment, in place of h's.

    h predicts some subgoals that no pushes reach. candidates: number of effect plans to rescore, the best by line 7.
    motions: codes sampled for the first segment of each plan, of which the one closest to the subgoal by f counts.
    From its last state h continues with the plan's other effect codes.

    Raises ValueError for counts below 1.
    """

    candidates: int = 32
    motions: int = 32

    def __post_init__(self) -> None:
        check_positive("candidates", self.candidates)
        check_positive("motions", self.motions)


def most_reachable(
    options: Reachability, effects: Candidates, predict: PredictEffect, model: PlanningModel, reward: RewardFunction
) -> Tensor:
    """The effect plan `[B]` int64 with the highest return by f and then h; among equals, the closest by f.

    effects: effect plans `[B, N]` of K segments; predict: h and the interpolation; the reward is that of motions.
    Raises ValueError where no rescored plan of an environment has a finite return.
    """
    count = min(options.candidates, effects.count)
    numbers = effects.returns.topk(count, -1).indices
    rescored = effects.take(numbers)
    codes = rescored.codes  # [B, F, K, C]
    first, distance = _first_segment(options, rescored, codes[:, :, 0], model, reward)
    problem = effects.problem
    space = _FixedFirstSegment(predict, first, codes)
    again = SearchProblem(space, problem.objective, problem.state, problem.generators, problem.segments).begin(count)
    for _ in range(problem.segments):
        again = again.extend()
    best = best_of(again.returns, "returns of effect plans, as far as motions reach them")
    equals = again.returns >= again.returns.gather(1, best.unsqueeze(-1))
    closest = best_of(prefer(-distance, equals), "distances of motions to subgoals")
    return numbers.gather(1, closest.unsqueeze(-1)).squeeze(-1)


def _first_segment(
    options: Reachability, effects: Candidates, codes: Tensor, model: PlanningModel, reward: RewardFunction
) -> tuple[SegmentRollout, Tensor]:
    """The motion `[B, F]` that comes closest to each effect plan's first subgoal, and its squared distance."""
    state, count = effects.problem.state, effects.count
    plans = state.expand_plans(count * options.motions)
    repeated = codes.repeat_interleave(options.motions, dim=1)  # [B, F m, C]
    motion = sample_each(model.motion_prior, [plans, repeated], effects.problem.generators)
    here = state.expand_plans(1)
    pushes = model.actions(here, repeated, motion)
    ends, path = predict_states(model, here, pushes)
    goals = State(
        effects.at(0, lambda segment: segment.rollout.states.centers).repeat_interleave(options.motions, dim=1),
        ends.features,
        plans.mask,
    )
    distance = squared_distance(ends, goals)
    progress = returns.advance(returns.start(plans.centers), reward, plans.centers, path, plans.mask)
    finite = torch.isfinite(distance) & torch.isfinite(pushes).all(-1).all(-1)
    distance = torch.where(finite, distance, torch.inf).unflatten(1, (count, options.motions))
    scores = prefer(-distance.flatten(0, 1), ~progress.failed.reshape(-1, options.motions))
    closest = scores.argmax(-1).unflatten(0, (-1, count))  # [B, F]
    number = closest + options.motions * torch.arange(count, device=closest.device)
    rows = torch.arange(len(number), device=number.device).unsqueeze(-1)
    rollout = SegmentRollout(codes, pushes[rows, number], ends.take_plans(number), path[rows, number])
    return rollout, distance.gather(-1, closest.unsqueeze(-1)).squeeze(-1)


class _FixedFirstSegment:
    """Given plans: f has predicted the first segment, h predicts the others from there."""

    dimension = 0  # no noise to search

    def __init__(self, predict: PredictEffect, first: SegmentRollout, codes: Tensor) -> None:
        self.predict, self.first, self.codes = predict, first, codes

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        if segment == 0:
            return self.first
        return self.predict(here, plans, self.codes[:, :, segment])
