"""Motions that still work where the tool meets the object a little elsewhere (our addition to Algorithm 1, line 10)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from models.state import State
from planning import ranking, returns
from planning.engine import Engine, directly
from planning.following import follow
from planning.inputs import check_positive, check_weight
from planning.protocol import PlanningModel, RewardFunction
from planning.sampling import noise_each

QUARTER = 4  # one in so many goes on to the next round, and is tried so many times as often


@dataclass(frozen=True)
class Robustness:
    """How the best motions are tried again with displaced pushes, and with outcomes that f did not expect.

    The best of a thousand motions is often one about which f errs: a push that just meets the object according
    to f, and just misses it on the table. Displacing its start tells the two apart. And the farther f sends an object,
    the farther it errs: a long push past a forbidden place fails more often than a short one.

    Tries go where they decide: there are rounds of them, after each of which the best quarter goes on and is tried four
    times as often (sequential halving, Karnin, Koren and Somekh, ICML 2013).

    finalists: motions that are tried again, the best by line 10. draws: times that each is tried in the first round.
    rounds: as many tries each, of fewer and fewer motions, until one is left. 1 tries all equally often.
    start_noise: standard deviation of a push's start, in normalised units (1 is half the reachable box).
    outcome_noise: standard deviation, in x and in y, of where a push leaves an object, per metre that f predicts it to
        move. A try fails by where the objects might be, while its distance to the subgoal is f's.
    failure_cost: square metres that a predicted failure adds to the squared distance to the subgoal.

    Raises ValueError for counts below 1, and for a noise or a cost that is negative or not finite.
    """

    finalists: int = 256
    draws: int = 2
    rounds: int = 3
    start_noise: float = 0.03
    outcome_noise: float = 0.5
    failure_cost: float = 0.3

    def __post_init__(self) -> None:
        check_positive("finalists", self.finalists)
        check_positive("draws", self.draws)
        check_positive("rounds", self.rounds)
        check_weight("start_noise", self.start_noise)
        check_weight("outcome_noise", self.outcome_noise)
        check_weight("failure_cost", self.failure_cost)


def try_again(
    robustness: Robustness,
    model: PlanningModel,
    reward: RewardFunction,
    state: State,
    goal: State,
    scores: Tensor,
    actions: Tensor,
    later: Tensor,
    generators: Sequence[torch.Generator],
    *,
    feature_weight: float,
    engine: Engine = directly,
) -> Tensor:
    """Number of the motion that did best on average, `[B]` int64.

    state: `[B]`, where all motions begin. goal: `[B, 1]`, the first subgoal. scores: `[B, N]`, the higher the better.
    actions: `[B, N, T, 4]`, the segment that will be executed. later: `[B, N]` square metres that the segments after it
    cost. A motion whose score or whose cost is not finite loses.
    """
    best = scores.topk(min(robustness.finalists, scores.shape[-1]), -1)
    numbers, draws, tried = best.indices, robustness.draws, 0
    hopeless = ~torch.isfinite(best.values)
    total = torch.zeros_like(best.values)  # cost of all tries so far
    for number in range(robustness.rounds):
        if number and total.shape[-1] == 1:
            break  # the choice is made
        if number:
            going = (total / tried).topk(max(1, total.shape[-1] // QUARTER), largest=False).indices
            numbers, hopeless, total = (field.gather(1, going) for field in (numbers, hopeless, total))
            draws = QUARTER * draws
        distance, failed = tries(
            robustness,
            model,
            reward,
            state,
            goal,
            actions.take_along_dim(numbers[..., None, None], dim=1),
            draws,
            generators,
            feature_weight=feature_weight,
            engine=engine,
        )
        cost = (distance + robustness.failure_cost * failed).sum(-1)
        cost = cost + draws * later.gather(1, numbers)
        total = torch.where(hopeless | ~torch.isfinite(cost), torch.inf, total + cost)
        tried += draws
    return numbers.gather(1, total.argmin(-1, keepdim=True)).squeeze(1)


def tries(
    robustness: Robustness,
    model: PlanningModel,
    reward: RewardFunction,
    state: State,
    goal: State,
    actions: Tensor,
    draws: int,
    generators: Sequence[torch.Generator],
    *,
    feature_weight: float = 0.0,
    engine: Engine = directly,
) -> tuple[Tensor, Tensor]:
    """What becomes of `actions: [B, R, T, 4]`, each of them displaced and tried `draws` times.

    Square metres to the `goal: [B, 1]`, `[B, R, draws]`, and whether the try fails, `[B, R, draws]` bool. `state: [B]`.
    """
    pushes = actions.unsqueeze(2).repeat(1, 1, draws, 1, 1).flatten(1, 2)  # [B, R draws, T, 4]
    pushes[..., :2] += robustness.start_noise * noise_each(pushes[..., :2].shape[1:], generators)
    errors = None
    if robustness.outcome_noise:
        errors = robustness.outcome_noise * noise_each((*pushes.shape[1:3], state.objects, 2), generators)
    pushes = pushes.clamp(-1.0, 1.0)
    distance, failed = engine(_attempts, model, reward, state, goal, pushes, errors, feature_weight)
    return distance.unflatten(1, (-1, draws)), failed.unflatten(1, (-1, draws))


def _attempts(
    model: PlanningModel,
    reward: RewardFunction,
    state: State,
    goal: State,
    pushes: Tensor,
    errors: Tensor | None,
    feature_weight: float,
) -> tuple[Tensor, Tensor]:
    """What becomes of `pushes: [B, n, T, 4]`: square metres to the `goal`, `[B, n]`, and whether they fail, bool."""
    plans = state.expand_plans(pushes.shape[1])
    before, mask = plans.centers, plans.mask
    here, path = follow(model, state.expand_plans(1), pushes)
    possible = path if errors is None else outcomes(before, path, errors)
    progress = returns.advance(returns.start(before), reward, before, possible, mask)
    return ranking.squared_distance(here, goal, feature_weight=feature_weight), progress.failed


def outcomes(start: Tensor, path: Tensor, errors: Tensor) -> Tensor:
    """Where objects might be after every push instead of on f's `path: [B, n, T, M, 3]` from `start: [B, n, M, 3]`.

    errors: `[B, n, T, M, 2]`, metres in x and in y per metre that f moves an object. Heights stay.
    """
    strides = (path - returns.before_each(start, path))[..., :2].norm(dim=-1, keepdim=True)
    return torch.cat([path[..., :2] + strides * errors, path[..., 2:]], -1)
