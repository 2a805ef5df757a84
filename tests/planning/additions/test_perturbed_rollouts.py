"""A motion that works only if the tool meets the object exactly loses against one that works nearby as well."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import Distribution, Normal

from cavin_pyro.models.state import State
from cavin_pyro.planning import PerturbedRollouts
from cavin_pyro.planning.additions.perturbed_rollouts import sequential_halving

SAMPLES = 64


class Grazing:
    """A push moves objects by its motion, but only if its start lies within `width` of zero (normalised).

    h moves everything by 0.1 m in x. g has two motions, which the sign of z tells apart: a wide one that ends 1 cm
    short of the subgoal, and a narrow one that reaches it exactly.
    """

    segment_length = 1
    effect_dimension = motion_dimension = 16
    narrow, wide = 0.001, 10.0

    def effect_prior(self, state: State) -> Distribution:
        return standard(state)

    def motion_prior(self, state: State, effect_code: Tensor) -> Distribution:
        return standard(state)

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        return moved(state, state.centers.new_full((*effect_code.shape[:-1], 1), 0.1))

    def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
        narrow = motion_code[..., :1] > 0
        distance = torch.where(narrow, 0.1, 0.09)
        return torch.cat(
            [torch.zeros_like(distance), narrow.to(distance), distance, narrow.to(distance)], -1
        ).unsqueeze(-2)

    def next_state(self, state: State, action: Tensor) -> State:
        width = torch.where(action[..., 3:] > 0, self.narrow, self.wide)
        meets = action[..., :1].abs() < width
        return moved(state, torch.where(meets, action[..., 2:3], 0.0))


def standard(state: State) -> Distribution:
    zeros = state.centers.new_zeros((*state.centers.shape[:-2], 16))
    return torch.distributions.Independent(Normal(zeros, 1.0), 1)


def moved(state: State, distance: Tensor) -> State:
    move = torch.cat([distance, torch.zeros_like(distance), torch.zeros_like(distance)], -1).unsqueeze(-2)
    centers = state.centers + move
    return State(centers, state.features.expand(*centers.shape[:-1], -1), state.mask.expand(centers.shape[:-1]))


def scenes(count: int) -> State:
    return State(torch.zeros(count, 2, 3), torch.zeros(count, 2, 4), torch.ones(count, 2, dtype=torch.bool))


def chosen_motion(
    toy: SimpleNamespace, robustness: PerturbedRollouts | None, model: Grazing | None = None, **options: object
) -> Tensor:
    planner = toy.plain(
        model or Grazing(), toy.GoalDisc(goal=(0.1, 0.0)), samples=SAMPLES, horizon=1, robustness=robustness, **options
    )
    return planner.plan(scenes(1), [torch.Generator().manual_seed(0)]).actions[0, 0, 2]


def test_without_it_the_best_motion_by_f_is_chosen(toy: SimpleNamespace) -> None:
    assert chosen_motion(toy, None) == pytest.approx(0.1)


def test_a_motion_that_works_nearby_as_well_wins(toy: SimpleNamespace) -> None:
    # All 64 motions are perturbed: the narrow ones then move nothing, 0.1 m from the subgoal instead of 0.01.
    assert chosen_motion(toy, PerturbedRollouts(candidates=SAMPLES, rollouts=4)) == pytest.approx(0.09)


def test_only_the_best_candidates_get_perturbed_rollouts(toy: SimpleNamespace) -> None:
    assert chosen_motion(toy, PerturbedRollouts(candidates=1)) == pytest.approx(0.1)
    assert chosen_motion(toy, PerturbedRollouts(candidates=10 * SAMPLES)) == pytest.approx(
        0.09
    )  # there are no more than N


def rollouts_of(options: PerturbedRollouts, model: Any, reward: Any, backend: Callable) -> None:
    """Two scenes with eight motions each, all the same."""
    state, actions = scenes(2), torch.zeros(2, 8, 3, 4)
    goal, nothing = state.map(lambda field: field.unsqueeze(1)), torch.zeros(2, 8)
    given = (
        options,
        model,
        reward,
        state,
        goal,
        nothing,
        actions,
        nothing,
        [torch.Generator().manual_seed(s) for s in (0, 1)],
    )
    sequential_halving(*given, backend=backend)


def test_all_motions_of_a_round_get_the_same_noise_and_every_other_rollout_its_opposite(toy: SimpleNamespace) -> None:
    noises: list[Tensor] = []

    def noting(function: Callable, *given: Any) -> Any:
        noises.append(given[4][..., :2])  # starts of the pushes, which were 0
        return function(*given)

    options = PerturbedRollouts(candidates=8, rollouts=4, rounds=2, start_noise=0.01)
    rollouts_of(options, toy.PointMass(), toy.GoalDisc(goal=(9.0, 9.0)), noting)
    assert len(noises) == 2
    for starts, count in zip(noises, (4, 16), strict=True):
        noise = starts.unflatten(1, (-1, count))  # [B, R, count, ...]
        assert (noise == noise[:, :1]).all()
        torch.testing.assert_close(noise.mean(2), torch.zeros_like(noise[:, :, 0]), atol=1e-7, rtol=0.0)
        assert noise[:, 0, : count // 2].flatten(1).unique().numel() == noise[:, 0, : count // 2].numel()
    assert not torch.isin(noises[1], noises[0]).any()  # another round has other noise
    assert noises[0].std() == pytest.approx(0.01, rel=0.3)


def test_a_predicted_failure_costs(toy: SimpleNamespace) -> None:
    class Edge(Grazing):
        """Every wide push ends beyond the edge in y once it is displaced; a narrow one stays."""

        def next_state(self, state: State, action: Tensor) -> State:
            after = super().next_state(state, action)
            beyond = torch.where((action[..., 3:] == 0) & (action[..., :1] != 0), -1e-3, 0.0).unsqueeze(-2)
            return after._replace(centers=after.centers + beyond * torch.tensor([0.0, 1.0, 0.0]))

    reward = toy.GoalDisc(goal=(0.1, 0.0), forbidden_below=-1e-4)

    def motion(cost: float) -> Tensor:
        robustness = PerturbedRollouts(candidates=SAMPLES, failure_cost=cost)
        planner = toy.plain(Edge(), reward, samples=SAMPLES, horizon=1, robustness=robustness)
        return planner.plan(scenes(1), [torch.Generator().manual_seed(0)]).actions[0, 0, 2]

    assert motion(0.0) == pytest.approx(0.09)  # two objects 1 cm off, against 10 cm
    assert motion(1.0) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"candidates": 0}, "candidates must be at least 1"),
        ({"rollouts": 0}, "rollouts must be at least 1"),
        ({"rounds": 0}, "rounds must be at least 1"),
        ({"reduction_factor": 0}, "reduction_factor must be at least 1"),
        ({"start_noise": -0.1}, "start_noise must be zero or a positive number"),
        ({"failure_cost": float("nan")}, "failure_cost must be zero or a positive number"),
    ],
)
def test_bad_options_are_one_clear_line(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PerturbedRollouts(**options)


def ones(count: int) -> State:
    return State(torch.zeros(count, 2, 3), torch.ones(count, 2, 4), torch.ones(count, 2, dtype=torch.bool))


def test_the_best_candidates_continue_with_more_rollouts(toy: SimpleNamespace) -> None:
    rolled_out = []

    def counting(function: Callable, *given: Any) -> Any:
        rolled_out.append(given[4])  # [B, n, T, 4] pushes
        return function(*given)

    state, actions = ones(2), torch.rand(2, SAMPLES, 1, 4, generator=torch.Generator().manual_seed(0))
    options = PerturbedRollouts(candidates=32, rollouts=2, rounds=3, start_noise=0.0)
    model: Any = toy.PointMass()  # whose f does what the push says, up to the objects' gain of zero
    goal = ones(2).map(lambda field: field.unsqueeze(1))
    scores = torch.arange(float(SAMPLES)).expand(2, -1)
    later = torch.stack([torch.arange(float(SAMPLES)), -torch.arange(float(SAMPLES))])  # the last ones are candidates
    given = model, toy.GoalDisc(goal=(9.0, 9.0)), state, goal, scores, actions, later, toy.generators(0, 1)
    chosen = sequential_halving(options, *given, backend=counting)  # type: ignore[arg-type]
    assert chosen.tolist() == [32, 63]
    assert [pushes.shape[1] for pushes in rolled_out] == [64, 64, 64]
    often = [[len(set(map(tuple, pushes[:, 0].tolist()))) for pushes in three] for three in rolled_out]
    assert often == [[32, 32], [8, 8], [2, 2]]


def test_each_candidate_may_have_its_own_goal(toy: SimpleNamespace) -> None:
    state, model = ones(2), toy.PointMass()
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
    state, model = ones(1), toy.PointMass()
    actions = torch.zeros(1, 3, 1, 4)
    actions[0, :, 0, 3] = torch.tensor([-1.0, 0.0, 0.0])  # the first one fails
    later = torch.tensor([[-0.2, 0.0, -0.05]])

    def chosen(cost: float) -> int:
        options = PerturbedRollouts(candidates=3, failure_cost=cost)
        given = options, model, toy.GoalDisc(goal=(9.0, 9.0), forbidden_below=-0.01), state, None, -later, actions
        return int(sequential_halving(*given, later, toy.generators(0)))

    assert [chosen(cost) for cost in (0.0, 0.1, 0.3)] == [0, 0, 2]
