"""A motion that works only if the tool meets the object exactly loses against one that works nearby as well."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning import CavinPlanner, Reward
from cavin_pyro.planning.additions import Choice, PerturbedRollouts
from cavin_pyro.planning.additions.perturbed_rollouts import sequential_halving
from cavin_pyro.planning.backends import eager
from cavin_pyro.planning.protocol import Query
from tests.planning.conftest import GoalDisc, PointMass, generators, move, scenes

SAMPLES = 64


class Grazing(PointMass):
    """A push moves objects by its motion in x, but only if its start lies within `width` of zero (normalised).

    h moves everything by 0.1 m in x. g has two motions, which the sign of z tells apart: a wide one that ends 1 cm
    short of the subgoal, and a narrow one that reaches it exactly.
    """

    segment_length = 1
    narrow, wide = 0.001, 10.0

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        return move(state, torch.tensor([0.1, 0.0]).expand(*effect_code.shape[:-1], 2))

    def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
        narrow = motion_code[..., :1] > 0
        distance = torch.where(narrow, 0.1, 0.09)
        push = [torch.zeros_like(distance), narrow.to(distance), distance, narrow.to(distance)]
        return torch.cat(push, -1).unsqueeze(-2)

    def next_state(self, state: State, action: Tensor) -> State:
        width = torch.where(action[..., 3:] > 0, self.narrow, self.wide)
        meets = action[..., :1].abs() < width
        return move(state, torch.where(meets, action[..., 2:3], 0.0) * torch.tensor([1.0, 0.0]))


def two_objects(count: int) -> State:
    return scenes([[(0.0, 0.0)] * 2] * count, gains=(1.0, 1.0))


def chosen_motion(
    toy: SimpleNamespace, *additions: PerturbedRollouts, model: Grazing | None = None, reward: Reward | None = None
) -> Tensor:
    planner = CavinPlanner(model or Grazing(), SAMPLES, 1, additions=["failure_avoidance", *additions])
    reward = reward or toy.GoalDisc(goal=(0.1, 0.0))
    return planner.plan(two_objects(1), reward=reward, generators=toy.generators(0)).actions[0, 0, 2]


def test_without_it_the_best_motion_by_f_is_chosen(toy: SimpleNamespace) -> None:
    assert chosen_motion(toy) == pytest.approx(0.1)


def test_a_motion_that_works_nearby_as_well_wins(toy: SimpleNamespace) -> None:
    # All 64 motions are perturbed: the narrow ones then move nothing, 0.1 m from the subgoal instead of 0.01.
    assert chosen_motion(toy, PerturbedRollouts(candidates=SAMPLES, rollouts=4)) == pytest.approx(0.09)


def test_only_the_best_candidates_get_perturbed_rollouts(toy: SimpleNamespace) -> None:
    assert chosen_motion(toy, PerturbedRollouts(candidates=1)) == pytest.approx(0.1)
    everything = PerturbedRollouts(candidates=10 * SAMPLES)  # there are no more than N
    assert chosen_motion(toy, everything) == pytest.approx(0.09)


def halving(
    robustness: PerturbedRollouts, state: State, below: float = -torch.inf, backend: Callable = eager, **tensors: Any
) -> list[int]:
    """The candidate of each scene that sequential halving chooses, with the f of a point mass."""
    scene = Query(state, GoalDisc((9.0, 9.0), forbidden_below=below), generators(*range(len(state.mask))))
    candidates: Any = SimpleNamespace(problem=SimpleNamespace(backend=backend))
    choice = Choice(scene, PointMass(), candidates, lambda: tensors["actions"])
    return sequential_halving(robustness, choice, **tensors).tolist()


def goal_at(state: State) -> State:
    """One goal of all candidates, where the scene is."""
    return state.map(lambda field: field.unsqueeze(1))


def test_all_motions_of_a_round_get_the_same_noise_and_every_other_rollout_its_opposite() -> None:
    noises: list[Tensor] = []

    def noting(function: Callable, *given: Any) -> Any:
        noises.append(given[4][..., :2])  # starts of the pushes, which were 0
        return function(*given)

    options = PerturbedRollouts(candidates=8, rollouts=4, rounds=2, reduction_factor=4, start_noise=0.01)
    state, actions, nothing = two_objects(2), torch.zeros(2, 8, 3, 4), torch.zeros(2, 8)  # eight motions, all the same
    halving(options, state, backend=noting, scores=nothing, goal=goal_at(state), actions=actions, later=nothing)
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
    free, costly = (PerturbedRollouts(candidates=SAMPLES, failure_cost=cost) for cost in (0.0, 1.0))
    # Two objects 1 cm off, against 10 cm.
    assert chosen_motion(toy, free, model=Edge(), reward=reward) == pytest.approx(0.09)
    assert chosen_motion(toy, costly, model=Edge(), reward=reward) == pytest.approx(0.1)


def test_the_best_candidates_continue_with_more_rollouts() -> None:
    rolled_out = []

    def counting(function: Callable, *given: Any) -> Any:
        rolled_out.append(given[4])  # [B, n, T, 4] pushes
        return function(*given)

    state, actions = two_objects(2), torch.rand(2, SAMPLES, 1, 4, generator=torch.Generator().manual_seed(0))
    options = PerturbedRollouts(candidates=32, rollouts=2, rounds=3, reduction_factor=4, start_noise=0.0)
    scores = torch.arange(float(SAMPLES)).expand(2, -1)
    later = torch.stack([scores[0], -scores[0]])  # the last ones are candidates
    tensors: Any = {"scores": scores, "goal": goal_at(state), "actions": actions, "later": later}
    assert halving(options, state, backend=counting, **tensors) == [32, 63]
    assert [pushes.shape[1] for pushes in rolled_out] == [64, 64, 64]
    often = [[len(set(map(tuple, pushes[:, 0].tolist()))) for pushes in three] for three in rolled_out]
    assert often == [[32, 32], [8, 8], [2, 2]]


def test_each_candidate_may_have_its_own_goal() -> None:
    state, actions = two_objects(2), torch.rand(2, SAMPLES, 3, 4, generator=torch.Generator().manual_seed(0))
    scores, later = torch.rand(2, SAMPLES, generator=torch.Generator().manual_seed(1)), torch.zeros(2, SAMPLES)
    options = PerturbedRollouts(candidates=32, rounds=3, reduction_factor=4)
    chosen = partial(halving, options, state, scores=scores, actions=actions, later=later)
    shared = goal_at(state)
    own = shared.map(lambda field: field.expand(-1, SAMPLES, *field.shape[2:]).clone())
    assert chosen(goal=own) == chosen(goal=shared)
    # One candidate of each scene ends exactly at its own goal, and all others a metre away from theirs.
    lucky = scores.topk(32).indices[:, 20]
    moves = 0.1 * actions[..., 2:].sum(-2)  # what f predicts
    own.centers[..., :2] = moves.unsqueeze(-2) + 1.0
    own.centers[[0, 1], lucky, :, :2] -= 1.0
    assert chosen(goal=own) == lucky.tolist()


def test_without_a_goal_failures_and_the_later_cost_decide() -> None:
    actions = torch.zeros(1, 3, 1, 4)
    actions[0, :, 0, 3] = torch.tensor([-1.0, 0.0, 0.0])  # the first one fails
    later = torch.tensor([[-0.2, 0.0, -0.05]])
    tensors: Any = {"scores": -later, "goal": None, "actions": actions, "later": later}
    for cost, chosen in ((0.0, 0), (0.1, 0), (0.3, 2)):
        options = PerturbedRollouts(candidates=3, failure_cost=cost)
        assert halving(options, two_objects(1), -0.01, **tensors) == [chosen]
