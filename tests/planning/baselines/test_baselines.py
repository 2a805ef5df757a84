"""SeCTAR, CVAE-MPC and MPC against replays by hand and by brute force. For the numbers see test_cavin_replay."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from models.state import State
from planning import CvaeMpcPlanner, MpcPlanner, Plan, PushBox, SectarPlanner
from planning.optimizers import Shooting

EFFECTS = [[-0.75, 0.5, -2.0], [0.5, 0.25, 1.0]]
RETURNS = [-2.0 - 1.0 + 99.0, -4.0, -2.0 + 99.0]
WITHOUT_REPLACEMENT = [-102.0, -4.0, -101.0]
NO_REPLACEMENT: dict[str, Any] = {"optimizer": Shooting(replacement=False)}
PLAIN: dict[str, Any] = {"warm_start": False, "robustness": None, "idle_distance": 0.0}  # the paper's
BOX = PushBox((0.3, -0.55), (0.8, 0.55), 0.1)


def sectar(toy: SimpleNamespace, effects: Sequence[Sequence[float]], **options: Any) -> Plan:
    class Single(toy.Tabled):  # type: ignore[name-defined]
        def actions(self, state: State, effect_code: Tensor) -> Tensor:
            return super().actions(state, effect_code, 0.125 * torch.eye(16)[0].expand_as(effect_code))

    planner = SectarPlanner(Single(effects, []), toy.Line(), samples=3, horizon=4, **PLAIN, **options)
    return planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(0))


def cvae_mpc(toy: SimpleNamespace, motions: Sequence[Sequence[float]], **options: Any) -> Plan:
    class Flat(toy.Tabled):  # type: ignore[name-defined]
        def motion_prior(self, state: State) -> Any:
            return super().motion_prior(state, state.centers)

        def actions(self, state: State, *, motion_code: Tensor) -> Tensor:
            return super().actions(state, torch.zeros_like(motion_code), motion_code)

    planner = CvaeMpcPlanner(Flat([], motions), toy.Line(), samples=3, horizon=4, **PLAIN, **options)
    return planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(0))


def line(centers: Tensor) -> list[float]:
    return centers[..., 0, 0].flatten().tolist()


def test_sectar_executes_what_g_makes_of_the_best_effect_code(toy: SimpleNamespace) -> None:
    plan = sectar(toy, EFFECTS)
    assert plan.candidate_returns.tolist() == [RETURNS]
    assert plan.effect_codes[0, :, 0].tolist() == [0.5, 1.0]
    assert line(plan.subgoals.centers) == [0.5, 1.5]
    assert plan.actions.tolist() == plan.planned_actions.tolist() == [[[0, 0, 0.375, 0]] * 2]
    assert line(plan.predicted_centers) == [0.375, 0.75]
    assert plan.motion_codes.shape == (1, 0, 0)


def test_sectar_without_replacement(toy: SimpleNamespace) -> None:
    plan = sectar(toy, EFFECTS, **NO_REPLACEMENT)
    assert plan.candidate_returns.tolist() == [WITHOUT_REPLACEMENT]
    assert line(plan.subgoals.centers) == [0.5, 0.75]


def test_sectar_executes_nothing_that_is_not_finite(toy: SimpleNamespace) -> None:
    class Broken(toy.Tabled):  # type: ignore[name-defined]
        def actions(self, state: State, effect_code: Tensor) -> Tensor:
            return torch.full((1, 1, 2, 4), torch.nan)

    planner = SectarPlanner(Broken(EFFECTS, []), toy.Line(), samples=3, horizon=4, warm_start=False)
    with pytest.raises(ValueError, match="^environment 0: the pushes of the chosen effect are not finite"):
        planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(0))


def test_cvae_mpc_agrees_with_the_replay_by_hand(toy: SimpleNamespace) -> None:
    # T = 2 pushes by z each: the same positions as those of the effects.
    plan = cvae_mpc(toy, [[code / 2 for code in row] for row in EFFECTS])
    assert plan.candidate_returns.tolist() == [RETURNS]
    assert plan.motion_codes[0, :, 0].tolist() == [0.25, 0.5]
    assert plan.planned_actions[0].tolist() == [[0, 0, 0.25, 0]] * 2 + [[0, 0, 0.5, 0]] * 2
    assert plan.actions.tolist() == plan.planned_actions[:, :2].tolist()
    assert line(plan.predicted_centers) == [0.25, 0.5, 1.0, 1.5]
    assert plan.segments.tolist() == [2]
    assert plan.expected_success.tolist() == [True]
    assert plan.subgoals.centers.shape == (1, 0, 1, 3)
    assert plan.candidate_centers[0, :, :, 0, 0].tolist() == [[0.5, 1.0], [0.5, 0.75], [0.5, 1.5]]


def test_cvae_mpc_without_replacement(toy: SimpleNamespace) -> None:
    plan = cvae_mpc(toy, [[code / 2 for code in row] for row in EFFECTS], **NO_REPLACEMENT)
    assert plan.candidate_returns.tolist() == [WITHOUT_REPLACEMENT]
    assert line(plan.predicted_centers) == [0.25, 0.5, 0.625, 0.75]


def test_pushes_that_are_not_finite_never_win_even_if_the_dynamics_ignore_it(toy: SimpleNamespace) -> None:
    class Careless(toy.Flat):  # type: ignore[name-defined]
        def actions(self, state: State, *, motion_code: Tensor) -> Tensor:
            pushes = super().actions(state, motion_code=motion_code)
            return pushes.masked_fill((motion_code[..., 0] > 0)[..., None, None], torch.nan)

        def next_state(self, state: State, action: Tensor) -> State:
            return super().next_state(state, action.nan_to_num(1.0))

    planner = CvaeMpcPlanner(Careless(), toy.GoalDisc((9.0, 9.0), dense=True), samples=64, horizon=6)
    assert planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(0)).planned_actions.isfinite().all()


def test_mpc_agrees_with_brute_force(toy: SimpleNamespace) -> None:
    model, reward, start = toy.PointMass(), toy.GoalDisc((0.3, 0.05), forbidden_below=-0.05, dense=True), (0.0, 0.0)
    planner = MpcPlanner(model, reward, samples=50, horizon=6, **PLAIN, **NO_REPLACEMENT)
    plan = planner.plan(toy.scenes([[start]]), toy.generators(4))
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


@pytest.mark.parametrize("proposal", ["uniform", "heuristic"])
def test_mpc_replaces_the_dead_and_repeats_with_its_seed(toy: SimpleNamespace, proposal: str) -> None:
    reward = toy.GoalDisc((9.0, 9.0), forbidden_below=0.0)
    planner = MpcPlanner(toy.PointMass(), reward, samples=64, horizon=12, proposal=proposal, box=BOX)
    state = toy.scenes([[(0.0, 0.02)], [(0.1, 0.3)]])
    plan, again = (planner.plan(state, toy.generators(1, 2)) for _ in range(2))
    assert torch.equal(plan.planned_actions, again.planned_actions)
    alone = planner.plan(state.scene(slice(1, 2)), toy.generators(2))
    assert torch.equal(plan.candidate_returns[1], alone.candidate_returns[0])
    firsts = plan.candidate_centers[0, :, 0, 0]
    assert (firsts[:, 1] >= 0).all()
    assert len(firsts.unique(dim=0)) < 64


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"proposal": "best"}, "unknown proposal 'best': choose uniform or heuristic"),
        ({"proposal": "heuristic"}, "proposal heuristic needs the box that pushes start in"),
        ({"samples": 0}, "samples must be at least 1, not 0"),
        ({"horizon": 31}, "horizon=31 is not divisible by the model's segment length T=3: choose 30 or 33"),
        ({"reward_at": "end"}, "unknown reward_at 'end': choose path or subgoals"),
    ],
)
def test_bad_options_are_one_clear_line(toy: SimpleNamespace, options: dict, message: str) -> None:
    with pytest.raises(ValueError) as error:
        MpcPlanner(toy.PointMass(), toy.Line(), **options)
    assert str(error.value) == message
