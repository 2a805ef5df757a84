"""The motion that is best in perturbed rollouts, by sequential halving."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from models.state import State
from planning import records
from planning.backends.eager import Backend, eager
from planning.extensions.perturbed_rollouts import ENDS, PerturbedRollouts, perturbed_rollouts
from planning.protocol import DynamicsModel, RewardFunction
from planning.rollouts.candidates import Candidates
from planning.rollouts.ranking import SubgoalDistance
from planning.rollouts.segment import actions_of


def most_robust(
    robustness: PerturbedRollouts,
    motions: Candidates,
    scores: Tensor,
    later_cost: Tensor,
    model: DynamicsModel,
    reward: RewardFunction,
    subgoals: State,
    distance: SubgoalDistance,
) -> Tensor:
    """The motion candidate with the lowest cost on average, `[B]` int64; see `sequential_halving`.

    Rollouts end where their distance to the subgoal counts: after T pushes, or after the first.
    """
    problem, goal = motions.problem, subgoals.step(slice(0, 1))
    actions = motions.at(0, lambda segment: actions_of(segment)[..., : distance.pushes(model.segment_length), :])
    what = problem.state, goal, scores, actions, later_cost, problem.generators
    return sequential_halving(robustness, model, reward, *what, distance=distance, backend=problem.backend)


def sequential_halving(
    robustness: PerturbedRollouts,
    model: DynamicsModel,
    reward: RewardFunction,
    state: State,
    goal: State | None,
    scores: Tensor,
    actions: Tensor,
    later: Tensor,
    generators: Sequence[torch.Generator],
    *,
    distance: SubgoalDistance = ENDS,
    backend: Backend = eager,
) -> Tensor:
    """The motion with the lowest cost on average, `[B]` int64.

    state: `[B]`, where all motions begin. goal: the first subgoal, `[B, 1]` of all motions or `[B, N]` of each; None
    without subgoals, where failures alone count. scores: `[B, N]`, the higher the better. actions: `[B, N, n, 4]`, the
    pushes to roll out, of the segment that will be executed. later: `[B, N]` square metres, the cost of the segments
    after it, and of guidance. distance: to the subgoal. A motion whose score or whose cost is not finite loses.
    """
    best = scores.topk(min(robustness.candidates, scores.shape[-1]), -1)
    indices, count, done = best.indices, robustness.rollouts, 0
    infinite = ~torch.isfinite(best.values)
    total = torch.zeros_like(best.values)  # cost of all rollouts so far
    for number in range(robustness.rounds):
        if number and total.shape[-1] == 1:
            break  # one candidate is left
        if number:
            going = (total / done).topk(max(1, total.shape[-1] // robustness.reduction_factor), largest=False).indices
            indices, infinite, total = (field.gather(1, going) for field in (indices, infinite, total))
            count = robustness.reduction_factor * count
        costs, failed = perturbed_rollouts(
            robustness,
            model,
            reward,
            state,
            goal if goal is None or goal.batch_shape[-1] == 1 else records.take(goal, indices),
            actions.take_along_dim(indices[..., None, None], dim=1),
            count,
            generators,
            distance=distance,
            backend=backend,
        )
        cost = (costs + robustness.failure_cost * failed).sum(-1)
        cost = cost + count * later.gather(1, indices)
        total = torch.where(infinite | ~torch.isfinite(cost), torch.inf, total + cost)
        done += count
    return indices.gather(1, total.argmin(-1, keepdim=True)).squeeze(1)
