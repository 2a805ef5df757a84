"""SeCTAR, CVAE-MPC, MPC and the ablation against replays by hand and by brute force; random pushes.

For the numbers see test_cavin_replay.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning import (
    CavinPlanner,
    CavinWithoutEffectsPlanner,
    CvaeMpcPlanner,
    MpcPlanner,
    Plan,
    PolicyPlanner,
    RandomPlanner,
    Reward,
    SectarPlanner,
)
from cavin_pyro.planning.additions import PerturbedRollouts
from cavin_pyro.planning.optimizers import Shooting
from tests.planning.conftest import line

EFFECTS = [[-0.75, 0.5, -2.0], [0.5, 0.25, 1.0]]
RETURNS = [-2.0 - 1.0 + 99.0, -4.0, -2.0 + 99.0]
PRESET = "early_stopping", PerturbedRollouts(256, rounds=3, reduction_factor=4)  # additions of their presets


def replay(toy: SimpleNamespace, kind: type, model: Any, **options: Any) -> Plan:
    planner = kind(model, samples=3, horizon=4, **options)
    return planner.plan(toy.scenes([[(0.0, 0.0)]]), reward=toy.Line(), generators=toy.generators(0))


def test_sectar_executes_what_g_makes_of_the_best_effect_code(toy: SimpleNamespace) -> None:
    class Single(toy.Tabled):  # type: ignore[name-defined]
        def actions(self, state: State, effect_code: Tensor) -> Tensor:
            return super().actions(state, effect_code, 0.125 * torch.eye(16)[0].expand_as(effect_code))

    plan = replay(toy, SectarPlanner, Single(EFFECTS, []))
    assert plan.candidate_returns.tolist() == [RETURNS]
    assert plan.effect_codes[0, :, 0].tolist() == [0.5, 1.0]
    assert line(plan.subgoals.centers) == [0.5, 1.5]
    assert plan.actions.tolist() == plan.planned_actions.tolist() == [[[0, 0, 0.375, 0]] * 2]
    assert line(plan.predicted_centers) == [0.375, 0.75]
    assert plan.motion_codes.shape == (1, 0, 0)


def test_sectar_executes_nothing_that_is_not_finite(toy: SimpleNamespace) -> None:
    class Broken(toy.Tabled):  # type: ignore[name-defined]
        def actions(self, state: State, effect_code: Tensor) -> Tensor:
            return torch.full((*effect_code.shape[:2], 2, 4), torch.nan)

    with pytest.raises(ValueError, match="^environment 0: the actions of the chosen effect are not finite"):
        replay(toy, SectarPlanner, Broken(EFFECTS, []), additions=[PerturbedRollouts()])


def test_cvae_mpc_agrees_with_the_replay_by_hand(toy: SimpleNamespace) -> None:
    class Flat(toy.Tabled):  # type: ignore[name-defined]
        def motion_prior(self, state: State) -> Any:
            return super().motion_prior(state, state.centers)

        def actions(self, state: State, *, motion_code: Tensor) -> Tensor:
            return super().actions(state, torch.zeros_like(motion_code), motion_code)

    # T = 2 pushes by z each: the same positions as those of the effects.
    plan = replay(toy, CvaeMpcPlanner, Flat([], [[code / 2 for code in row] for row in EFFECTS]))
    assert plan.candidate_returns.tolist() == [RETURNS]
    assert plan.motion_codes[0, :, 0].tolist() == [0.25, 0.5]
    assert plan.planned_actions[0].tolist() == [[0, 0, 0.25, 0]] * 2 + [[0, 0, 0.5, 0]] * 2
    assert plan.actions.tolist() == plan.planned_actions[:, :2].tolist()
    assert line(plan.predicted_centers) == [0.25, 0.5, 1.0, 1.5]
    assert plan.segments.tolist() == [2]
    assert plan.expected_success.tolist() == [True]
    assert plan.subgoals.centers.shape == (1, 0, 1, 3)
    assert plan.candidate_centers[0, :, :, 0, 0].tolist() == [[0.5, 1.0], [0.5, 0.75], [0.5, 1.5]]


def test_mpc_agrees_with_brute_force(toy: SimpleNamespace) -> None:
    model, reward, start = toy.PointMass(), toy.GoalDisc((0.3, 0.05), forbidden_below=-0.05, dense=True), (0.0, 0.0)
    planner = MpcPlanner(model, samples=50, horizon=6, optimizer=Shooting(replacement=False))
    plan = planner.plan(toy.scenes([[start]]), reward=reward, generators=toy.generators(4))
    source = toy.generators(4)[0]
    draws = [torch.randn(50, 12, generator=source) for _ in range(2)]  # a segment at a time
    normal = torch.distributions.Normal(0.0, 1.0)
    pushes = (2 * normal.cdf(torch.cat(draws, -1)) - 1).unflatten(-1, (6, 4))
    totals = []
    for sequence in pushes:
        state, total = toy.scenes([[start]]), 0.0
        for push in sequence:
            before, state = state, model.next_state(state, push)
            outcome = reward(before.centers, state.centers, state.mask)
            total += outcome.reward.item()
            if outcome.success or outcome.failure:
                break
        totals.append(total)
    torch.testing.assert_close(plan.candidate_returns[0], torch.tensor(totals))
    torch.testing.assert_close(plan.planned_actions[0], pushes[int(torch.tensor(totals).argmax())])
    assert len({round(total) for total in totals}) > 2  # some die, and at different times


def test_mpc_replaces_the_dead_and_repeats_with_its_seed(toy: SimpleNamespace) -> None:
    reward = toy.GoalDisc((9.0, 9.0), forbidden_below=0.0)
    planner = MpcPlanner(toy.PointMass(), samples=64, horizon=12, additions=PRESET)
    state = toy.scenes([[(0.0, 0.02)], [(0.1, 0.3)]])
    plan, again = (planner.plan(state, reward=reward, generators=toy.generators(1, 2)) for _ in range(2))
    assert torch.equal(plan.planned_actions, again.planned_actions)
    alone = planner.plan(state.scene(slice(1, 2)), reward=reward, generators=toy.generators(2))
    assert torch.equal(plan.candidate_returns[1], alone.candidate_returns[0])
    firsts = plan.candidate_centers[0, :, 0, 0]
    assert (firsts[:, 1] >= 0).all()
    assert len(firsts.unique(dim=0)) < 64


ALL = PerturbedRollouts(candidates=64, rollouts=4)


def planner_of(toy: SimpleNamespace, kind: type, *additions: object, horizon: int = 6) -> Any:
    model = {SectarPlanner: toy.Single, CvaeMpcPlanner: toy.Flat}.get(kind, toy.PointMass)
    return kind(model(), samples=64, horizon=horizon, additions=additions)


each_kind = pytest.mark.parametrize("kind", [SectarPlanner, CvaeMpcPlanner, MpcPlanner, CavinWithoutEffectsPlanner])


@each_kind
def test_without_additions_the_first_of_the_highest_returns_wins(kind: type, toy: SimpleNamespace) -> None:
    state, reward = toy.scenes([[(0.0, 0.0)], [(0.1, 0.0)]]), toy.GoalDisc((0.25, 0.0), dense=True)
    plan = planner_of(toy, kind).plan(state, reward=reward, generators=toy.generators(1, 2))
    best = plan.candidate_returns.argmax(-1)
    assert torch.equal(plan.expected_return, plan.candidate_returns.amax(-1))
    ends = plan.candidate_centers[[0, 1], best]
    found = plan.subgoals.centers if kind is SectarPlanner else plan.predicted_centers[:, [2, 5]]
    torch.testing.assert_close(found, ends)


@each_kind
def test_a_plan_with_additions_does_not_depend_on_its_neighbours(kind: type, toy: SimpleNamespace) -> None:
    planner, reward = planner_of(toy, kind, *PRESET), toy.GoalDisc((0.25, 0.0), forbidden_below=-0.05)
    state = toy.scenes([[(0.0, 0.0)], [(0.1, 0.0)]])
    both = planner.plan(state, reward=reward, generators=toy.generators(1, 2))
    alone = planner.plan(state.scene(slice(1, 2)), reward=reward, generators=toy.generators(2))
    torch.testing.assert_close(both.planned_actions[1], alone.planned_actions[0])


@each_kind
def test_the_first_segment_stays_farther_from_forbidden_places(kind: type, toy: SimpleNamespace) -> None:
    # Where a push starts moves objects as its motion does, and starts are perturbed by 0.2, 2 cm.
    reward, state = toy.GoalDisc((0.2, 0.0), radius=0.1, forbidden_below=-0.01), toy.scenes([[(0.0, 0.0)]] * 8)
    perturbed = PerturbedRollouts(candidates=64, rollouts=8, start_noise=0.2)
    noise = 0.2 * torch.randn(500, 8, 3, 2, generator=toy.generators(0)[0])
    shares = []
    for additions in ([], [perturbed]):
        planner = planner_of(toy, kind, *additions)
        planner.model.next_state = lambda state, action: toy.move(state, 0.1 * (action[..., 2:] + action[..., :2]))
        pushes = planner.plan(state, reward=reward, generators=toy.generators(*range(8))).actions
        starts = (pushes[..., :2] + noise).clamp(-1.0, 1.0)
        path = 0.1 * (starts + pushes[..., 2:]).cumsum(-2)
        shares.append((path[..., 1] < -0.01).any(-1).float().mean())
    assert shares[1] < 0.8 * shares[0]


@each_kind
def test_where_nothing_fails_the_highest_return_wins(kind: type, toy: SimpleNamespace) -> None:
    # Not the pushes that do least: they never fail, and come closest to their own subgoals.
    state, reward = toy.scenes([[(0.0, 0.0)]] * 8), toy.GoalDisc((0.25, 0.0), radius=0.15)
    reward.maximum_return = torch.inf  # no rollout stops early
    plan = planner_of(toy, kind, *PRESET, horizon=15).plan(state, reward=reward, generators=toy.generators(*range(8)))
    assert plan.expected_success.all() and len(plan.candidate_returns.unique()) > 4
    assert torch.equal(plan.expected_return, plan.candidate_returns.amax(-1))


def test_sectar_prefers_effects_that_its_pushes_reach(toy: SimpleNamespace) -> None:
    class Imprecise(toy.Single):  # type: ignore[misc]
        """Effects with a positive second code end 5 cm farther than their pushes."""

        def subgoal(self, state: State, effect_code: Tensor) -> State:
            reached = super().subgoal(state, effect_code)
            error = 0.05 * (effect_code[..., 1] > 0)[..., None, None] * torch.tensor([0.0, 1.0, 0.0])
            return reached._replace(centers=reached.centers + error)

    reward, state = toy.GoalDisc((0.1, 0.0), radius=0.2), toy.scenes([[(-0.15, 0.0)]] * 8)
    signs = []
    for additions in ([], [ALL]):
        planner = SectarPlanner(Imprecise(), samples=64, horizon=6, additions=additions)
        plan = planner.plan(state, reward=reward, generators=toy.generators(*range(8)))
        signs.append((plan.effect_codes[:, 0, 1] > 0).sum())
    assert signs[0] > 0 and signs[1] == 0


@pytest.mark.parametrize("kind", [CvaeMpcPlanner, SectarPlanner])
def test_pushes_that_are_not_finite_never_win(kind: type, toy: SimpleNamespace) -> None:
    planner, reward = planner_of(toy, kind, ALL), toy.GoalDisc((0.2, 0.0), radius=0.15)
    whole, model = planner.model.actions, planner.model

    def broken(state: State, *codes: Tensor, **named: Tensor) -> Tensor:
        code = codes[0] if codes else named["motion_code"]
        return whole(state, *codes, **named).masked_fill((code[..., 1] > 0)[..., None, None], torch.nan)

    model.actions, model.next_state = broken, lambda state, action: toy.move(state, 0.1 * action[..., 2:].nan_to_num())
    if kind is SectarPlanner:
        planner._actions = broken
    plan = planner.plan(toy.scenes([[(0.0, 0.0)]] * 4), reward=reward, generators=toy.generators(*range(4)))
    assert plan.actions.isfinite().all()


def test_codes_are_sampled_as_the_cascade_generates_them(toy: SimpleNamespace) -> None:
    # Two segments of three samples: a row of each table per segment, and T = 2 pushes by c / 2 + z.
    effects, motions = [[-0.5, 0.5, -2.0], [0.25, 0.5, 0.0]], [[0.0, 0.125, 0.0], [0.0, 0.25, 0.0]]
    plan = replay(toy, CavinWithoutEffectsPlanner, toy.Tabled(effects, motions))
    # The second one goes to 0.75, where a copy of it takes the first one's place, and succeeds with its third push.
    assert plan.candidate_returns[0, 1] == -2.0 + 99.0 == plan.expected_return
    assert plan.motion_codes[0, :, [0, 16]].tolist() == [[0.5, 0.125], [0.5, 0.25]]
    assert plan.planned_actions[0, :, 2].tolist() == [0.375, 0.375, 0.5, 0.5]
    assert plan.predicted_centers[0, :2, 0, 0].tolist() == [0.375, 0.75]
    assert plan.motion_codes.shape == (1, 2, 32) and plan.effect_codes.shape == (1, 0, 0)
    assert plan.subgoals.centers.shape == (1, 0, 1, 3)


@pytest.mark.parametrize("horizon", ["full_horizon", "first_segment"])
def test_one_motion_is_the_one_that_is_drawn(horizon: str, toy: SimpleNamespace) -> None:
    asked = []

    class Counting(toy.PointMass):  # type: ignore[name-defined]
        def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
            asked.append(motion_code)
            return super().actions(state, effect_code, motion_code)

    one, many = (
        CavinPlanner(model, 64, 6, horizon, motion_share=share).plan(
            toy.scenes([[(0.0, 0.0)]]), reward=toy.GoalDisc((0.3, 0.0)), generators=toy.generators(1)
        )
        for model, share in ((Counting(), 1 / 64), (toy.PointMass(), 1.0))
    )
    assert [code.shape for code in asked] == [(1, 1, 16)] * (2 if horizon == "full_horizon" else 1)
    assert torch.equal(one.motion_codes[:, :1], asked[0])
    assert torch.equal(one.effect_codes, many.effect_codes)


def test_pushes_are_uniform_in_the_normalised_box(toy: SimpleNamespace) -> None:
    planner = RandomPlanner(segment_length=20000, action_dimension=4)
    actions = planner.plan(toy.scenes([[(0.0, 0.0)]]), generators=toy.generators(0)).actions[0]
    quantiles = actions.quantile(torch.tensor([0.0, 0.1, 0.5, 0.9, 1.0]), dim=0)
    expected = torch.tensor([-1.0, -0.8, 0.0, 0.8, 1.0])[:, None].expand(-1, 4)
    torch.testing.assert_close(quantiles, expected, rtol=0, atol=0.03)


def test_a_policy_acts_in_one_scene_with_an_action_of_the_world(toy: SimpleNamespace) -> None:
    def push(state: State, reward: Reward, observed: Any) -> torch.Tensor:
        return torch.cat((state.centers[0, :2], torch.ones(2)))[None]

    state, reward = toy.scenes([[(0.25, 0.5)]]), toy.GoalDisc((0.2, 0.0))
    plan = PolicyPlanner(push, action_dimension=4).plan(state, reward=reward, generators=toy.generators(0))
    assert plan.actions.tolist() == [[[0.25, 0.5, 1.0, 1.0]]] and plan.share_reaching_goal is None
    with pytest.raises(ValueError, match=r"must give an action \[1, 3\], not \[1, 4\]"):
        PolicyPlanner(push, action_dimension=3).plan(state, reward=reward, generators=toy.generators(0))
    with pytest.raises(ValueError, match=r"must give an action \[1, 4\], not \[0.5\]"):
        PolicyPlanner(lambda *_: [0.5], action_dimension=4).plan(state, reward=reward, generators=toy.generators(0))
    with pytest.raises(ValueError, match="one scene at a time, not in 2"):
        PolicyPlanner(push, action_dimension=4).plan(
            toy.scenes([[(0.0, 0.0)]] * 2), reward=reward, generators=toy.generators(0, 1)
        )
