"""Rollouts with perturbed actions (our addition to Algorithm 1, line 10, and to the baselines)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cavin_pyro.models.checks import check_number
from cavin_pyro.models.state import State
from cavin_pyro.planning import records, returns
from cavin_pyro.planning.additions.addition import Addition, Choice
from cavin_pyro.planning.protocol import Reward, TransitionModel, unwrap
from cavin_pyro.planning.returns import SubgoalDistance, TrackingState, prefer
from cavin_pyro.planning.rollout import predict_states
from cavin_pyro.planning.sampling import noise_each

# Square metres per unit of return, where returns and distances add up. The default cost of a failure, 0.3 square
# metres, is then worth 200: a failure earns -100 instead of the +100 at the goal.
RETURN_WEIGHT = 0.0015


@dataclass(frozen=True)
class PerturbedRollouts(Addition):
    """Ranks the best motions by rollouts of perturbed actions (docs/explanation/planning.md).

    Without a tracking cost, in the baselines, the score of a plan is its return minus `failure_cost / RETURN_WEIGHT`
    times the fraction of failed rollouts, by default 200 times: about the expected return of a plan with predicted
    success. Plans that reach the goal rank first, since the rollouts of others may have stopped early and actions
    that do nothing never fail. Where plans have subgoals of their own, those that miss the goal are ranked by return
    alone: the actions that move least would end closest to their own subgoals.

    Sequential halving (Karnin, Koren and Somekh, ICML 2013) allocates the rollouts; after each round the best
    candidates, one in `reduction_factor`, continue with `reduction_factor` times as many rollouts each.

    Two standard reductions of variance make few rollouts tell motions apart (Law, Simulation Modeling and Analysis,
    chapter on variance reduction): all motions of a round get the same noise (common random numbers), and half of the
    rollouts of a motion the noise of the other half with the opposite sign (antithetic variates).

    candidates: motions with perturbed rollouts, the best by line 10, or by their return in the baselines.
    rollouts: number for each candidate in the first round.
    rounds: number of rounds, each with as many rollouts in total, for fewer and fewer candidates; 1 gives every
        candidate the same number.
    reduction_factor: how many times fewer candidates a round has than the one before.
    start_noise: standard deviation of an action's first two numbers, on the table the push's start.
    failure_cost: square metres that a predicted failure adds to the squared distance to the subgoal. Where returns
        count, one unit of return weighs 0.0015 square metres.

    Raises ValueError for counts below 1, and for a noise or a cost that is negative or not finite.
    """

    candidates: int = 64
    rollouts: int = 2
    rounds: int = 2
    reduction_factor: int = 8
    start_noise: float = 0.03
    failure_cost: float = 0.3

    def __post_init__(self) -> None:
        for name in ("candidates", "rollouts", "rounds", "reduction_factor"):
            check_number(name, getattr(self, name), 1, whole=True)
        check_number("start_noise", self.start_noise)
        check_number("failure_cost", self.failure_cost)

    def rank(self, scores: Tensor, choice: Choice) -> Tensor:
        """See `Addition`: all but the best on average are left out."""
        goal, actions = choice.subgoals, choice.first_actions()
        ranked = scores
        if choice.effect is not None:
            tracking = unwrap(choice.candidates.score_state, TrackingState)
            goal, later = choice.effect.subgoals.step(slice(0, 1)), tracking.cost - tracking.executed_cost
            later = later + torch.where(torch.isfinite(scores), tracking.returns - scores, 0.0)  # by other additions
        else:
            reached = choice.candidates.progress.succeeded
            if goal is None:
                ranked = prefer(scores, reached)
            else:
                finite = torch.isfinite(actions).all(-1).all(-1)
                ranked = torch.where(reached & finite, scores, -torch.inf)
            later = -RETURN_WEIGHT * ranked
        best = sequential_halving(
            self,
            choice,
            scores=ranked,
            goal=goal,
            actions=actions[..., : choice.distance.steps(choice.model.segment_length), :],
            later=later,
        )
        chosen = torch.zeros_like(scores, dtype=torch.bool).scatter(1, best.unsqueeze(-1), True)
        chosen = chosen | ~torch.isfinite(ranked).any(-1, keepdim=True)
        return torch.where(chosen, scores, -torch.inf)


def sequential_halving(
    robustness: PerturbedRollouts, choice: Choice, *, scores: Tensor, goal: State | None, actions: Tensor, later: Tensor
) -> Tensor:
    """The candidate with the lowest cost on average, `[B]` int64; it advances the generators.

    Args:
        scores: `[B, N]`, the higher the better; one whose score or whose cost is not finite loses.
        goal: the first subgoal, `[B, 1]` of all or `[B, N]` of each; None where failures alone count.
        actions: `[B, N, n, A]`, to roll out, of the segment that will be executed. Rollouts end where their distance
            to the subgoal counts: after T pushes, or after the first.
        later: `[B, N]` square metres, the cost of the segments after it, and of guidance.
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
            choice,
            goal=goal if goal is None or goal.batch_shape[-1] == 1 else records.take(goal, indices),
            actions=actions.take_along_dim(indices[..., None, None], dim=1),
            count=count,
        )
        cost = (costs + robustness.failure_cost * failed).sum(-1)
        cost = cost + count * later.gather(1, indices)
        total = torch.where(infinite | ~torch.isfinite(cost), torch.inf, total + cost)
        done += count
    return indices.gather(1, total.argmin(-1, keepdim=True)).squeeze(1)


def perturbed_rollouts(
    robustness: PerturbedRollouts, choice: Choice, *, goal: State | None, actions: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """Rollouts of `actions: [B, R, n, A]` by f from the scenes' states, each perturbed `count` times.

    Returns the square metres to the `goal: [B, 1]` or `[B, R]` (0 without a goal), and whether a rollout fails,
    `[B, R, count]` each.
    """
    scene, backend = choice.scene, choice.candidates.problem.backend
    if goal is not None and goal.batch_shape[-1] > 1:
        goal = goal.map(lambda field: field.repeat_interleave(count, 1))  # [B, R count]
    tried = actions.unsqueeze(2).repeat(1, 1, count, 1, 1).flatten(1, 2)  # [B, R count, n, A]
    half = noise_each((-(-count // 2), tried.shape[-2], 2), scene.generators, tried.device)
    noise = torch.cat((half, -half), 1)[:, :count]  # antithetic: its mean is 0 for an even count
    tried[..., :2] += robustness.start_noise * noise.repeat(1, actions.shape[1], 1, 1)  # the same for every motion
    tried = tried.clamp(-1.0, 1.0)
    costs, failed = backend(_rollout_costs, choice.model, scene.reward, scene.state, goal, tried, choice.distance)
    return costs.unflatten(1, (-1, count)), failed.unflatten(1, (-1, count))


def _rollout_costs(
    model: TransitionModel, reward: Reward, state: State, goal: State | None, actions: Tensor, distance: SubgoalDistance
) -> tuple[Tensor, Tensor]:
    """Rollouts of `actions: [B, n, T, A]` by f: square metres to the `goal` and whether they fail, `[B, n]` each."""
    plans = state.expand_plans(actions.shape[1])
    end, path = predict_states(model, state.expand_plans(1), actions, reward.reads_features)
    start = plans.values(reward.reads_features)
    progress = returns.advance(returns.start(plans.centers), reward, start, path, plans.mask)
    if goal is None:
        return torch.zeros_like(progress.returns), progress.failed
    return distance(end, path, goal), progress.failed
