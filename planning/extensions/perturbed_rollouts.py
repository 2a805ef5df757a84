"""Rollouts with perturbed pushes and outcomes (our addition to Algorithm 1, line 10, and to the baselines)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from models.state import State
from planning.backends.eager import Backend, eager
from planning.inputs import check_choice, check_positive, check_weight
from planning.protocol import DynamicsModel, RewardFunction, SampledDynamics
from planning.rollouts import returns
from planning.rollouts.dynamics import predict_states, sample_states
from planning.rollouts.ranking import SubgoalDistance
from planning.rollouts.sampling import noise_each, uniform_each

# Square metres per unit of return, where returns and distances add up. The default cost of a failure, 0.3 square
# metres, is then worth 200: a failure earns -100 instead of the +100 at the goal.
RETURN_WEIGHT = 0.0015
OUTCOMES = ("perturbed", "sampled")
ENDS = SubgoalDistance()


@dataclass(frozen=True)
class PerturbedRollouts:
    """Ranks the best motions by rollouts with perturbed pushes and perturbed outcomes.

    The best of a thousand motions often exploits an error of f: a push just meets the object according to f, and just
    misses it on the table. A perturbed start reveals such pushes. The error of f also grows with the distance
    that an object moves: a long push past a forbidden place fails more often than a short one.

    The defaults are those of the baselines; `planning.cavin.FEW_CANDIDATES` are those of `planner=cavin`.

    Sequential halving (Karnin, Koren and Somekh, ICML 2013) allocates the rollouts; after each round the best
    candidates, one in `reduction_factor`, continue with `reduction_factor` times as many rollouts each.

    Two standard reductions of variance make few rollouts tell motions apart (Law, Simulation Modeling and Analysis,
    chapter on variance reduction): all motions of a round get the same noise (common random numbers), and half of the
    rollouts of a motion the noise of the other half with the opposite sign (antithetic variates). Outcomes that are
    sampled have common numbers only.

    candidates: motions with perturbed rollouts, the best by line 10, or by their return in the baselines.
    rollouts: number for each candidate in the first round.
    rounds: number of rounds, each with as many rollouts in total, for fewer and fewer candidates; 1 gives every
        candidate the same number.
    reduction_factor: how many times fewer candidates a round has than the one before.
    outcomes: `perturbed`, with the two noises below, or `sampled` from f's own predictive distribution, push by push.
        A sampled rollout continues from its own samples, which also give its distance to the subgoal; its pushes start
        unperturbed.
    start_noise: standard deviation of a push's start, in normalised units (1 is half the reachable box).
    outcome_noise: standard deviation, in x and in y, of an object's centre after a push, per metre of its predicted
        move. The perturbed centres decide whether a rollout fails; its distance to the subgoal is that of f's
        prediction.
    failure_cost: square metres that a predicted failure adds to the squared distance to the subgoal. Where returns
        count, one unit of return weighs 0.0015 square metres.

    Raises ValueError for counts below 1, unknown outcomes, and for a noise or a cost that is negative or not finite.
    """

    candidates: int = 256
    rollouts: int = 2
    rounds: int = 3
    reduction_factor: int = 4
    outcomes: str = "perturbed"
    start_noise: float = 0.03
    outcome_noise: float = 0.5
    failure_cost: float = 0.3

    def __post_init__(self) -> None:
        check_positive("candidates", self.candidates)
        check_positive("rollouts", self.rollouts)
        check_positive("rounds", self.rounds)
        check_positive("reduction_factor", self.reduction_factor)
        check_choice("outcomes", self.outcomes, OUTCOMES)
        check_weight("start_noise", self.start_noise)
        check_weight("outcome_noise", self.outcome_noise)
        check_weight("failure_cost", self.failure_cost)


def perturbed_rollouts(
    robustness: PerturbedRollouts,
    model: DynamicsModel,
    reward: RewardFunction,
    state: State,
    goal: State | None,
    actions: Tensor,
    count: int,
    generators: Sequence[torch.Generator],
    *,
    distance: SubgoalDistance = ENDS,
    backend: Backend = eager,
) -> tuple[Tensor, Tensor]:
    """Rollouts of `actions: [B, R, T, 4]` by f from `state: [B]`, each perturbed `count` times.

    Returns the square metres to the `goal: [B, 1]` or `[B, R]`, by `distance` (0 without a goal), and whether a rollout
    fails, `[B, R, count]` each.
    """
    if goal is not None and goal.batch_shape[-1] > 1:
        goal = goal.map(lambda field: field.repeat_interleave(count, 1))  # [B, R count]
    pushes = actions.unsqueeze(2).repeat(1, 1, count, 1, 1).flatten(1, 2)  # [B, R count, T, 4]
    of_objects = (count, pushes.shape[-2], state.objects, 2)
    if robustness.outcomes == "sampled":
        uniform = _for_each_motion(uniform_each(of_objects, generators, pushes.device), pushes)
        costs, failed = backend(_sampled_costs, model, reward, state, goal, pushes, uniform, distance)
        return costs.unflatten(1, (-1, count)), failed.unflatten(1, (-1, count))
    starts = _antithetic_noise((*of_objects[:2], 2), generators, pushes.device)
    pushes[..., :2] += robustness.start_noise * _for_each_motion(starts, pushes)
    errors = None
    if robustness.outcome_noise:
        noise = _antithetic_noise(of_objects, generators, pushes.device)
        errors = robustness.outcome_noise * _for_each_motion(noise, pushes)
    pushes = pushes.clamp(-1.0, 1.0)
    costs, failed = backend(_rollout_costs, model, reward, state, goal, pushes, errors, distance)
    return costs.unflatten(1, (-1, count)), failed.unflatten(1, (-1, count))


def _antithetic_noise(shape: Sequence[int], generators: Sequence[torch.Generator], device: torch.device) -> Tensor:
    """Normal noise `[B, n, ...]`, whose second half is the first with the opposite sign: its mean is 0 if n is even."""
    count, *rest = shape
    half = noise_each((-(-count // 2), *rest), generators, device)
    return torch.cat((half, -half), 1)[:, :count]


def _for_each_motion(noise: Tensor, pushes: Tensor) -> Tensor:
    """The same `noise: [B, count, ...]` for the rollouts of every motion: `[B, R count, ...]`, as `pushes`."""
    return noise.repeat(1, pushes.shape[1] // noise.shape[1], *(noise.dim() - 2) * [1])


def _rollout_costs(
    model: DynamicsModel,
    reward: RewardFunction,
    state: State,
    goal: State | None,
    pushes: Tensor,
    errors: Tensor | None,
    distance: SubgoalDistance,
) -> tuple[Tensor, Tensor]:
    """Rollouts of `pushes: [B, n, T, 4]` by f: square metres to the `goal` and whether they fail, `[B, n]` each."""
    plans = state.expand_plans(pushes.shape[1])
    before, mask = plans.centers, plans.mask
    end, path = predict_states(model, state.expand_plans(1), pushes)
    possible = path if errors is None else outcomes(before, path, errors)
    return _costs(reward, before, possible, mask, end, path, goal, distance)


def _sampled_costs(
    model: SampledDynamics,
    reward: RewardFunction,
    state: State,
    goal: State | None,
    pushes: Tensor,
    uniform: Tensor,
    distance: SubgoalDistance,
) -> tuple[Tensor, Tensor]:
    """The same of rollouts that f's distributions sample, which `uniform: [B, n, T, M, 2]` determines."""
    plans = state.expand_plans(pushes.shape[1])
    end, path = sample_states(model, state.expand_plans(1), pushes, uniform)
    return _costs(reward, plans.centers, path, plans.mask, end, path, goal, distance)


def _costs(
    reward: RewardFunction,
    before: Tensor,
    possible: Tensor,
    mask: Tensor,
    end: State,
    path: Tensor,
    goal: State | None,
    distance: SubgoalDistance,
) -> tuple[Tensor, Tensor]:
    progress = returns.advance(returns.start(before), reward, before, possible, mask)
    if goal is None:
        return progress.returns.new_zeros(possible.shape[:2]), progress.failed
    return distance(end, path, goal), progress.failed


def outcomes(start: Tensor, path: Tensor, errors: Tensor) -> Tensor:
    """Perturbed centres after every push, instead of f's `path: [B, n, T, M, 3]` from `start: [B, n, M, 3]`.

    errors: `[B, n, T, M, 2]`, metres in x and in y per metre that f moves an object. Heights do not change.
    """
    strides = (path - returns.before_each(start, path))[..., :2].norm(dim=-1, keepdim=True)
    return torch.cat([path[..., :2] + strides * errors, path[..., 2:]], -1)
