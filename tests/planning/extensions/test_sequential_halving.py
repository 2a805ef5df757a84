"""Few rollouts find the motion that is best in many, and go to those that may still be it."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from models.state import State
from planning import CavinPlanner, PerturbedRollouts
from planning.extensions import sequential_halving as halving
from planning.extensions.sequential_halving import sequential_halving

SAMPLES = 64


def scenes(count: int) -> State:
    return State(torch.zeros(count, 2, 3), torch.ones(count, 2, 4), torch.ones(count, 2, dtype=torch.bool))


class Slipping:
    """A push moves all objects by 0.1 m of its motion, and by where it starts as well: 1 cm for noise of 0.1."""

    segment_length = 1

    def next_state(self, state: State, action: Tensor) -> State:
        return self.moved(state, 0.1 * (action[..., 2:3] + action[..., :1]), 0)

    def moved(self, state: State, distance: Tensor, axis: int) -> State:
        centers = state.centers + distance.unsqueeze(-2) * torch.eye(3)[axis]
        return State(centers, state.features.expand(*centers.shape[:-1], -1), state.mask.expand(centers.shape[:-1]))


class Unlucky(Slipping):
    """A push goes beyond an edge where its start, times a large number of its own, has a fraction below its motion."""

    def next_state(self, state: State, action: Tensor) -> State:
        chance = (action[..., :1] * 1e4 * (1.0 + action[..., 3:])).remainder(1.0)
        return self.moved(state, torch.where(chance < action[..., 2:3], -1.0, 0.0), 1)


def test_the_best_candidates_continue_with_more_rollouts(toy: SimpleNamespace) -> None:
    rolled_out = []

    def counting(function: Callable, *given: Any) -> Any:
        rolled_out.append(given[4])  # [B, n, T, 4] pushes
        return function(*given)

    state, actions = scenes(2), torch.rand(2, SAMPLES, 1, 4, generator=torch.Generator().manual_seed(0))
    options = PerturbedRollouts(candidates=32, rollouts=2, rounds=3, start_noise=0.0, outcome_noise=0.0)
    model: Any = toy.PointMass()  # whose f does what the push says, up to the objects' gain of zero
    goal = scenes(2).map(lambda field: field.unsqueeze(1))
    scores = torch.arange(float(SAMPLES)).expand(2, -1)
    later = torch.stack([torch.arange(float(SAMPLES)), -torch.arange(float(SAMPLES))])  # the last ones are candidates
    given = model, toy.GoalDisc(goal=(9.0, 9.0)), state, goal, scores, actions, later, toy.generators(0, 1)
    chosen = sequential_halving(options, *given, backend=counting)  # type: ignore[arg-type]
    assert chosen.tolist() == [32, 63]
    assert [pushes.shape[1] for pushes in rolled_out] == [64, 64, 64]
    often = [[len(set(map(tuple, pushes[:, 0].tolist()))) for pushes in three] for three in rolled_out]
    assert often == [[32, 32], [8, 8], [2, 2]]


def test_fewer_candidates_continue_with_a_larger_reduction_factor(toy: SimpleNamespace) -> None:
    moving = []

    def counting(function: Callable, *given: Any) -> Any:
        moving.append(len(given[4][0, :, 0, 2].unique()))
        return function(*given)

    state, scores = scenes(1), torch.zeros(1, SAMPLES)
    actions = torch.zeros(1, SAMPLES, 1, 4)
    actions[..., 2] = torch.linspace(0.0, 0.5, SAMPLES)[:, None]
    options = PerturbedRollouts(candidates=SAMPLES, rounds=3, reduction_factor=8)
    goal = state.map(lambda field: field.unsqueeze(1))
    given = options, toy.PointMass(), toy.GoalDisc(goal=(9.0, 9.0)), state, goal, scores, actions, scores
    sequential_halving(*given, toy.generators(0), backend=counting)
    assert moving == [64, 8, 1]


def test_the_last_candidate_gets_no_more_rollouts(toy: SimpleNamespace) -> None:
    rolled_out = []

    def counting(function: Callable, *given: Any) -> Any:
        rolled_out.append(given[4].shape[1])
        return function(*given)

    state, scores = scenes(1), torch.zeros(1, SAMPLES)
    given = toy.PointMass(), toy.GoalDisc(goal=(9.0, 9.0)), state, state.map(lambda field: field.unsqueeze(1)), scores
    options = PerturbedRollouts(candidates=5, rollouts=2, rounds=40)
    actions = torch.zeros(1, SAMPLES, 1, 4)
    sequential_halving(options, *given, actions, scores, toy.generators(0), backend=counting)  # type: ignore[arg-type]
    assert rolled_out == [10, 8]


def test_as_many_tries_shared_out_in_rounds_find_better_motions_than_equal_shares(toy: SimpleNamespace) -> None:
    state = scenes(40)
    goal, generators = state.map(lambda field: field.unsqueeze(1)), toy.generators(*range(40))
    actions = torch.zeros(40, SAMPLES, 1, 4)
    actions[..., 2] = torch.linspace(0.05, 0.6, SAMPLES)[:, None]  # 5 to 60 % of the rollouts fail
    actions[..., 3] = torch.rand(SAMPLES, 1, generator=torch.Generator().manual_seed(0))
    scores = torch.zeros(40, SAMPLES)
    reward = toy.GoalDisc(goal=(9.0, 9.0), forbidden_below=-0.01)
    failing = []
    for options in ({"rollouts": 12, "rounds": 1}, {"rollouts": 4, "rounds": 3}):
        robustness = PerturbedRollouts(candidates=SAMPLES, outcome_noise=0.0, start_noise=0.3, **options)
        given = Unlucky(), reward, state, goal, scores, actions, scores, generators
        chosen = sequential_halving(robustness, *given)
        failing.append(actions[range(40), chosen, 0, 2].mean())
    assert failing[1] < 0.8 * failing[0]


def test_shared_noise_orders_motions_that_noise_of_their_own_would_confuse(toy: SimpleNamespace) -> None:
    state, model = scenes(40), toy.PointMass()
    goal, generators = state.map(lambda field: field.unsqueeze(1)), toy.generators(*range(40))
    actions = torch.zeros(40, SAMPLES, 1, 4)
    actions[..., 2] = torch.linspace(0.0, 0.02, SAMPLES)[:, None]  # 2 mm between the shortest and the longest
    order = torch.randperm(SAMPLES, generator=torch.Generator().manual_seed(0))
    given = model, toy.GoalDisc(goal=(9.0, 9.0)), state, goal, torch.zeros(40, SAMPLES), actions[:, order]
    robustness = PerturbedRollouts(candidates=SAMPLES, rounds=1, outcome_noise=0.0, start_noise=0.1)
    chosen = sequential_halving(robustness, Slipping(), *given[1:], torch.zeros(40, SAMPLES), generators)
    assert (order[chosen] == 0).all()


def test_each_candidate_may_have_its_own_goal(toy: SimpleNamespace) -> None:
    state, model = scenes(2), toy.PointMass()
    actions = torch.rand(2, SAMPLES, 3, 4, generator=torch.Generator().manual_seed(0))
    scores, later = torch.rand(2, SAMPLES, generator=torch.Generator().manual_seed(1)), torch.zeros(2, SAMPLES)
    options = PerturbedRollouts(candidates=32)

    def chosen(goal: State) -> list[int]:
        given = options, model, toy.GoalDisc(goal=(9.0, 9.0)), state, goal, scores, actions, later
        return sequential_halving(*given, toy.generators(0, 1)).tolist()

    shared = state.map(lambda field: field.unsqueeze(1))
    own = shared.map(lambda field: field.expand(-1, SAMPLES, *field.shape[2:]).clone())
    assert chosen(own) == chosen(shared)
    # One candidate of each scene ends exactly at its own goal, and all others a metre away from theirs.
    lucky = scores.topk(32).indices[:, 20]
    moves = 0.1 * actions[..., 2:].sum(-2)  # what f predicts
    own.centers[..., :2] = moves.unsqueeze(-2) + 1.0
    own.centers[[0, 1], lucky, :, :2] -= 1.0
    assert chosen(own) == lucky.tolist()


def test_without_a_goal_failures_and_the_later_cost_decide(toy: SimpleNamespace) -> None:
    state, model = scenes(1), toy.PointMass()
    actions = torch.zeros(1, 3, 1, 4)
    actions[0, :, 0, 3] = torch.tensor([-1.0, 0.0, 0.0])  # the first one fails
    later = torch.tensor([[-0.2, 0.0, -0.05]])

    def chosen(cost: float) -> int:
        options = PerturbedRollouts(candidates=3, failure_cost=cost)
        given = options, model, toy.GoalDisc(goal=(9.0, 9.0), forbidden_below=-0.01), state, None, -later, actions
        return int(sequential_halving(*given, later, toy.generators(0)))

    assert [chosen(cost) for cost in (0.0, 0.1, 0.3)] == [0, 0, 2]


def test_rollouts_end_where_their_distance_to_the_subgoal_counts(
    toy: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    pushes = []

    def watched(*given: Any, **options: Any) -> Any:
        pushes.append(given[6].shape[-2])  # [B, N, ., 4] actions
        return sequential_halving(*given, **options)

    monkeypatch.setattr(halving, "sequential_halving", watched)
    for tracking_at in ("end", "first_push"):
        reward = toy.GoalDisc(goal=(0.25, 0.05))
        planner = CavinPlanner(toy.PointMass(), reward, samples=16, horizon=6, tracking_at=tracking_at)
        planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(0))
    assert pushes == [3, 1]
