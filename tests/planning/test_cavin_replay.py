"""Algorithm 1 against a replay by hand: one object on a line, T = 2, codes from a table.

The object succeeds from x = 1 on (+100), fails up to x = -0.5 (-100), and each step costs 1.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from cavin_pyro.planning import Addition, CavinPlanner, Plan
from cavin_pyro.planning.additions import Choice
from cavin_pyro.planning.optimizers import Shooting
from tests.planning.conftest import line

# Segment 1, from x = 0: plan 0 dies at its second step (-0.75), plan 1 gets to 0.5, plan 2 dies at its first
# step (-1.0). So plans 0 and 2 become copies of plan 1, and segment 2 starts at x = 0.5 for all: plan 0
# succeeds at its second step (1.0), plan 1 does not (0.75), plan 2 does at its first (1.0, headed for 1.5).
EFFECTS = [[-0.75, 0.5, -2.0], [0.5, 0.25, 1.0]]
RETURNS = [-2.0 - 1.0 + 99.0, -4.0, -2.0 + 99.0]
# Chosen: plan 2, with the first code of plan 1: c = (0.5, 1.0), subgoals 0.5 and 1.5.
# Squared distances to these (each push moves c / 2 + z):
#   0: segment 1 ends at 1.0  (0.25),   segment 2 at 1.5  (0.0)     sum 0.25
#   1: segment 1 ends at 0.75 (0.0625), segment 2 at 1.75 (0.0625)  sum 0.125
#   2: segment 1 ends at 0.5  (0.0),    segment 2 at 2.5  (1.0)     sum 1.0
MOTIONS = [[0.25, 0.125, 0.0], [-0.25, 0.0, 0.5]]


def replay(toy: SimpleNamespace, effects: list, motions: list, **options: Any) -> Plan:
    planner = CavinPlanner(toy.Tabled(effects, motions), samples=3, horizon=4, **options)
    return planner.plan(toy.scenes([[(0.0, 0.0)]]), reward=toy.Line(), generators=toy.generators(0))


def avoiding(toy: SimpleNamespace, effects: list, motions: list) -> list[float]:
    """The first motion code that is chosen with failure avoidance, and without."""
    plans = [replay(toy, effects, motions, additions=one) for one in (["failure_avoidance"], [])]
    return [plan.motion_codes[0, 0, 0].item() for plan in plans]


def test_effect_level_agrees_with_the_replay_by_hand(toy: SimpleNamespace) -> None:
    plan = replay(toy, EFFECTS, MOTIONS)
    assert plan.candidate_returns.tolist() == [RETURNS]
    assert plan.candidate_centers[0, :, :, 0, 0].tolist() == [[0.5, 1.0], [0.5, 0.75], [0.5, 1.5]]
    assert plan.effect_codes[0, :, 0].tolist() == [0.5, 1.0]
    assert line(plan.subgoals.centers) == [0.5, 1.5]
    assert plan.expected_return.tolist() == [97.0]
    assert plan.expected_success.tolist() == [True]
    assert plan.segments.tolist() == [2]


def test_motion_level_agrees_with_the_replay_by_hand(toy: SimpleNamespace) -> None:
    plan = replay(toy, EFFECTS, MOTIONS)
    assert plan.motion_codes[0, :, 0].tolist() == [0.125, 0.0]
    assert plan.planned_actions[0].tolist() == [[0, 0, 0.375, 0]] * 2 + [[0, 0, 0.5, 0]] * 2
    assert plan.actions.tolist() == plan.planned_actions[:, :2].tolist()
    assert line(plan.predicted_centers) == [0.375, 0.75, 1.25, 1.75]


def test_without_replacement_the_dead_stay_dead(toy: SimpleNamespace) -> None:
    # Plans 0 and 2 end in segment 1, as above, and only plan 1 goes on, to 0.75: c = (0.5, 0.25).
    plan = replay(toy, EFFECTS, MOTIONS, optimizer=Shooting(replacement=False))
    assert plan.candidate_returns.tolist() == [[-102.0, -4.0, -101.0]]
    assert plan.candidate_centers[0, :, :, 0, 0].tolist() == [[-0.75, -0.75], [0.5, 0.75], [-2.0, -2.0]]
    assert plan.effect_codes[0, :, 0].tolist() == [0.5, 0.25]
    assert line(plan.subgoals.centers) == [0.5, 0.75]
    assert plan.expected_return.tolist() == [-4.0]
    assert plan.segments.tolist() == [2]
    # Segment 1 ends at 1.0, 0.75, 0.5 and segment 2 at 0.75, 1.0, 1.75: squared distances 0.25, 0.125, 1.0.
    assert plan.motion_codes[0, :, 0].tolist() == [0.125, 0.0]
    assert plan.planned_actions[0].tolist() == [[0, 0, 0.375, 0]] * 2 + [[0, 0, 0.125, 0]] * 2
    assert line(plan.predicted_centers) == [0.375, 0.75, 0.875, 1.0]


def test_reward_at_subgoals_does_not_see_what_happens_on_the_way(toy: SimpleNamespace) -> None:
    # One step per segment: plan 0 gets to -0.25 and from there to 1.25; plan 2 would have died on the way.
    plan = replay(toy, [[-0.25, 0.5, -2.0], [1.5, 0.25, 0.25]], MOTIONS, reward_at="subgoals")
    assert plan.candidate_returns[0, :2].tolist() == [-1.0 + 99.0, -2.0]
    assert plan.candidate_returns[0, 2] in (-1.0 - 1.0, -1.0 + 99.0)  # a copy of plan 0 or 1, with a code of its own
    assert line(plan.subgoals.centers) == [-0.25, 1.25]


def test_first_segment_compares_the_first_segment_only(toy: SimpleNamespace) -> None:
    plan = replay(toy, EFFECTS, MOTIONS[:1], motion_horizon="first_segment")
    assert plan.motion_codes[0, :, 0].tolist() == [0.0]
    assert plan.actions.tolist() == plan.planned_actions.tolist() == [[[0, 0, 0.25, 0]] * 2]
    assert line(plan.predicted_centers) == [0.25, 0.5]
    assert line(plan.subgoals.centers) == [0.5, 1.5]


def test_a_successful_plan_is_neither_replaced_nor_moved_on_from(toy: SimpleNamespace) -> None:
    # Plan 0 succeeds in segment 1 (x = 1.0 at its second step); -3 would move it into the forbidden part.
    effects = [[1.0, 0.5, -2.0], [-3.0, 0.25, 0.25]]
    # Only segment 1 has anything to aim at: sequence 1 comes closest, and may fail in segment 2.
    motions = [[0.5, -0.0625, 0.25], [0.0, -9.0, 0.0]]
    plan = replay(toy, effects, motions, additions=["failure_avoidance"])
    assert plan.candidate_returns.tolist() == [[-1.0 + 99.0, -4.0, -4.0]]
    assert plan.expected_return.tolist() == [98.0]
    assert plan.segments.tolist() == [1]
    assert line(plan.subgoals.centers) == [1.0, 1.0]
    assert plan.motion_codes[0, 0, 0] == -0.0625


def test_where_every_plan_has_died_the_best_of_the_dead_is_chosen(toy: SimpleNamespace) -> None:
    effects = [[-0.75, -2.0, -3.0], [9.0, 9.0, 9.0]]
    plan = replay(toy, effects, MOTIONS)
    assert plan.candidate_returns.tolist() == [[-102.0, -101.0, -101.0]]
    assert plan.effect_codes[0, 0, 0] == -2.0
    assert plan.segments.tolist() == [1]
    assert line(plan.subgoals.centers) == [-2.0, -2.0]
    assert not plan.expected_success.any()


def test_predicted_failures_lose(toy: SimpleNamespace) -> None:
    # The chosen subgoal is -0.25; sequence 0 ends at -0.5 (a failure), sequence 2 at 0.25, farther away.
    effects, motions = [[-0.25] * 3, [0.0] * 3], [[-0.125, -0.5, 0.25], [0.0] * 3]
    assert avoiding(toy, effects, motions) == [0.25, -0.125]


def test_predicted_failures_lose_in_later_segments_too(toy: SimpleNamespace) -> None:
    # Subgoals -0.25 and -0.25. Sequence 0 hits the first and fails in segment 2; 1 and 2 keep off, 1 closer.
    effects, motions = [[-0.25] * 3, [0.0] * 3], [[0.0, 0.25, 0.375], [-0.125, 0.0, 0.0]]
    assert avoiding(toy, effects, motions) == [0.25, 0.0]


def test_where_all_fail_those_that_fail_later_than_the_executed_segment_win(toy: SimpleNamespace) -> None:
    # Subgoals -0.25 and -0.25. Sequence 0 fails at once and comes back; 1 and 2 fail in segment 2, 1 closer.
    effects = [[-0.25] * 3, [0.0] * 3]
    motions = [[-0.125, 0.125, 0.25], [0.125, -0.375, -0.75]]
    assert avoiding(toy, effects, motions) == [0.125, -0.125]


def test_what_another_addition_leaves_out_stays_out_where_all_motions_fail(toy: SimpleNamespace) -> None:
    class NotTheFirst(Addition):
        def rank(self, scores: Tensor, choice: Choice) -> Tensor:
            return scores.where(torch.arange(3) > 0, -torch.inf)

    additions = [NotTheFirst(), "failure_avoidance"]
    plan = replay(toy, [[-0.25] * 3, [0.0] * 3], [[-0.375, -0.5, -0.75], [0.0] * 3], additions=additions)
    assert plan.motion_codes[0, 0, 0] == -0.5


@pytest.mark.parametrize("additions", [[], ["failure_avoidance"]])
@pytest.mark.parametrize("motion_horizon", ["full_horizon", "first_segment"])
def test_motions_that_are_not_finite_never_win(toy: SimpleNamespace, motion_horizon: str, additions: list) -> None:
    motions = [[float("nan"), 0.25, float("inf")], [0.0, 0.0, 0.0]]
    plan = replay(toy, EFFECTS, motions, motion_horizon=motion_horizon, additions=additions)
    assert plan.motion_codes[0, 0, 0] == 0.25
    assert plan.planned_actions.isfinite().all()


def test_where_no_motion_is_finite_nothing_is_executed(toy: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match=r"^environment 0: none of the 3 distances of motion plans .* finite"):
        replay(toy, EFFECTS, [[float("nan")] * 3, [0.0] * 3])
