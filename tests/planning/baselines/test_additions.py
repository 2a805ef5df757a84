"""Our additions to the baselines: perturbed rollouts and idle pushes last; without them, the plain search."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from models.state import State
from planning import CavinWithoutEffectsPlanner, CvaeMpcPlanner, MpcPlanner, PerturbedRollouts, SectarPlanner
from planning.searching import SearchingPlanner

OFF: dict[str, Any] = {"warm_start": False, "robustness": None, "idle_distance": 0.0}
ALL = PerturbedRollouts(candidates=64, rollouts=4)


def single(toy: SimpleNamespace) -> type:
    class Single(toy.PointMass):  # type: ignore[name-defined]
        """One code for effects and pushes, which do what h says."""

        def actions(self, state: State, effect_code: Tensor) -> Tensor:
            return super().actions(state, effect_code, torch.zeros_like(effect_code))

    return Single


def sectar(toy: SimpleNamespace, reward: object, **options: Any) -> SectarPlanner:
    return SectarPlanner(single(toy)(), reward, samples=64, **{"horizon": 6, **options})  # type: ignore[arg-type]


def cvae_mpc(toy: SimpleNamespace, reward: object, **options: Any) -> CvaeMpcPlanner:
    return CvaeMpcPlanner(toy.Flat(), reward, samples=64, **{"horizon": 6, **options})  # type: ignore[arg-type]


def mpc(toy: SimpleNamespace, reward: object, **options: Any) -> MpcPlanner:
    return MpcPlanner(toy.PointMass(), reward, samples=64, **{"horizon": 6, **options})  # type: ignore[arg-type]


def without_effects(toy: SimpleNamespace, reward: object, **options: Any) -> CavinWithoutEffectsPlanner:
    return CavinWithoutEffectsPlanner(toy.PointMass(), reward, samples=64, **{"horizon": 6, **options})  # type: ignore[arg-type]


FACTORIES: list[Callable[..., SearchingPlanner]] = [sectar, cvae_mpc, mpc, without_effects]


@pytest.mark.parametrize("make", FACTORIES)
def test_without_additions_the_first_of_the_highest_returns_wins(make: Callable, toy: SimpleNamespace) -> None:
    state = toy.scenes([[(0.0, 0.0)], [(0.1, 0.0)]])
    plan = make(toy, toy.GoalDisc((0.25, 0.0), dense=True), **OFF).plan(state, toy.generators(1, 2))
    best = plan.candidate_returns.argmax(-1)
    assert torch.equal(plan.expected_return, plan.candidate_returns.amax(-1))
    ends = plan.candidate_centers[[0, 1], best]
    found = plan.subgoals.centers if make is sectar else plan.predicted_centers[:, [2, 5]]
    torch.testing.assert_close(found, ends)


@pytest.mark.parametrize("make", FACTORIES)
def test_a_plan_with_additions_does_not_depend_on_its_neighbours(make: Callable, toy: SimpleNamespace) -> None:
    planner = make(toy, toy.GoalDisc((0.25, 0.0), forbidden_below=-0.05))
    assert planner.robustness == PerturbedRollouts() and planner.idle_distance == 0.01
    state = toy.scenes([[(0.0, 0.0)], [(0.1, 0.0)]])
    both, alone = (
        planner.plan(state, toy.generators(1, 2)),
        planner.plan(state.scene(slice(1, 2)), toy.generators(2)),
    )
    torch.testing.assert_close(both.planned_actions[1], alone.planned_actions[0])


@pytest.mark.parametrize("make", FACTORIES)
def test_the_first_segment_stays_farther_from_forbidden_places(make: Callable, toy: SimpleNamespace) -> None:
    # Outcomes in y spread by half of the distance that f predicts.
    reward, state = toy.GoalDisc((0.2, 0.0), radius=0.1, forbidden_below=-0.01), toy.scenes([[(0.0, 0.0)]] * 8)
    shares = []
    for robustness in (None, ALL):
        plan = make(toy, reward, **{**OFF, "robustness": robustness}).plan(state, toy.generators(*range(8)))
        path = plan.predicted_centers[:, :3]
        moves = (path - torch.cat([state.centers.unsqueeze(1), path[:, :-1]], 1))[..., :2].norm(dim=-1, keepdim=True)
        spread = path[..., 1:2] + 0.5 * moves * torch.randn(1000, *moves.shape, generator=toy.generators(0)[0])
        shares.append((spread < -0.01).flatten(2).any(-1).float().mean())
    assert shares[1] < 0.7 * shares[0]


@pytest.mark.parametrize("make", FACTORIES)
def test_where_nothing_fails_the_highest_return_wins(make: Callable, toy: SimpleNamespace) -> None:
    # Not the pushes that do least: they never fail, and come closest to their own subgoals.
    state, reward = toy.scenes([[(0.0, 0.0)]] * 8), toy.GoalDisc((0.25, 0.0), radius=0.15)
    reward.maximum_return = torch.inf  # no rollout stops early
    plan = make(toy, reward, horizon=15).plan(state, toy.generators(*range(8)))
    assert plan.expected_success.all() and len(plan.candidate_returns.unique()) > 4
    assert torch.equal(plan.expected_return, plan.candidate_returns.amax(-1))


@pytest.mark.parametrize("make", FACTORIES)
def test_a_risky_way_to_the_goal_comes_before_doing_nothing(make: Callable, toy: SimpleNamespace) -> None:
    state, reward = toy.scenes([[(0.0, 0.02)]] * 8), toy.GoalDisc((0.2, 0.02), radius=0.1, forbidden_below=0.0)
    plan = make(toy, reward).plan(state, toy.generators(*range(8)))
    assert torch.equal(plan.expected_success, plan.candidate_returns.amax(-1) > 0) and plan.expected_success.any()


def test_sectar_takes_the_best_return_where_no_plan_reaches_the_goal(toy: SimpleNamespace) -> None:
    reward, state = toy.GoalDisc((9.0, 9.0), dense=True), toy.scenes([[(0.0, 0.0)]])
    plain, ours = (
        sectar(toy, reward, **{**OFF, "robustness": robustness}).plan(state, toy.generators(1))
        for robustness in (None, ALL)
    )
    assert torch.equal(plain.actions, ours.actions)


def test_sectar_prefers_effects_that_its_pushes_reach(toy: SimpleNamespace) -> None:
    class Imprecise(single(toy)):  # type: ignore[misc]
        """Effects with a positive second code end 5 cm farther than their pushes."""

        def subgoal(self, state: State, effect_code: Tensor) -> State:
            reached = super().subgoal(state, effect_code)
            error = 0.05 * (effect_code[..., 1] > 0)[..., None, None] * torch.tensor([0.0, 1.0, 0.0])
            return reached._replace(centers=reached.centers + error)

    reward, state = toy.GoalDisc((0.1, 0.0), radius=0.2), toy.scenes([[(-0.15, 0.0)]] * 8)
    signs = []
    for robustness in (None, ALL):
        planner = SectarPlanner(Imprecise(), reward, samples=64, horizon=6, **{**OFF, "robustness": robustness})
        signs.append((planner.plan(state, toy.generators(*range(8))).effect_codes[:, 0, 1] > 0).sum())
    assert signs[0] > 0 and signs[1] == 0


@pytest.mark.parametrize("make", [cvae_mpc, sectar])
def test_pushes_that_are_not_finite_never_win(make: Callable, toy: SimpleNamespace) -> None:
    reward = toy.GoalDisc((0.2, 0.0), radius=0.15)
    planner = make(toy, reward, **{**OFF, "robustness": ALL})
    whole, model = planner.model.actions, planner.model

    def broken(state: State, *codes: Tensor, **named: Tensor) -> Tensor:
        code = codes[0] if codes else named["motion_code"]
        return whole(state, *codes, **named).masked_fill((code[..., 1] > 0)[..., None, None], torch.nan)

    model.actions, model.next_state = broken, lambda state, action: toy.move(state, 0.1 * action[..., 2:].nan_to_num())
    if make is sectar:
        planner._actions = broken
    plan = planner.plan(toy.scenes([[(0.0, 0.0)]] * 4), toy.generators(*range(4)))
    assert plan.actions.isfinite().all()


@pytest.mark.parametrize("make", [cvae_mpc, sectar, without_effects])
def test_idle_pushes_come_last(make: Callable, toy: SimpleNamespace) -> None:
    planner = make(toy, toy.GoalDisc((0.2, 0.0)), **{**OFF, "idle_distance": 0.01})
    whole = planner.model.actions

    def hesitant(state: State, *codes: Tensor, **named: Tensor) -> Tensor:
        return whole(state, *codes, **named) * torch.tensor([0.0, 1.0, 1.0]).unsqueeze(-1)

    planner.model.actions = hesitant
    if make is sectar:
        planner._actions = hesitant
    plan = planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(0))
    assert plan.actions[0, 2].abs().max() == 0.0 < plan.actions[0, 0].abs().max()
    assert torch.equal(plan.planned_actions[:, :3], plan.actions)
    last = plan.predicted_centers
    assert torch.equal(last[0, 0], (toy.scenes([[(0.0, 0.0)]]).centers + 0.1 * _planar(plan.actions[:, 0]))[0])


def _planar(action: Tensor) -> Tensor:
    return torch.cat([action[..., 2:], torch.zeros_like(action[..., :1])], -1).unsqueeze(-2)
