"""The floor: uniform random pushes."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from planning import RandomPlanner


def test_pushes_are_uniform_in_the_normalised_box(toy: SimpleNamespace) -> None:
    state = toy.scenes([[(0.0, 0.0)]])
    actions = RandomPlanner(segment_length=20000).plan(state, toy.generators(0)).actions[0]
    assert actions.abs().max() <= 1.0
    for quantile in (0.1, 0.5, 0.9):
        torch.testing.assert_close(
            actions.quantile(quantile, dim=0), torch.full((4,), 2 * quantile - 1), rtol=0, atol=0.03
        )


def test_pushes_depend_on_the_environments_own_generator_only(toy: SimpleNamespace) -> None:
    planner = RandomPlanner()
    together = planner.plan(toy.scenes([[(0.0, 0.0)]] * 2), toy.generators(3, 4))
    alone = planner.plan(toy.scenes([[(0.7, 0.7)]]), toy.generators(4))
    assert torch.equal(together.actions[1], alone.actions[0])
    assert not torch.equal(together.actions[0], together.actions[1])


def test_a_random_plan_has_pushes_and_nothing_else(toy: SimpleNamespace) -> None:
    state = toy.scenes([[(0.0, 0.0), (0.1, 0.1)]] * 3, gains=(1.0, 1.0))
    plan = RandomPlanner().plan(state, toy.generators(0, 1, 2))
    assert plan.actions.shape == plan.planned_actions.shape == (3, 3, 4)
    assert plan.subgoals.centers.shape == (3, 0, 2, 3)
    assert plan.predicted_centers.shape == (3, 0, 2, 3)
    assert plan.candidate_centers.shape == (3, 0, 0, 2, 3)
    assert plan.candidate_returns.shape == (3, 0)
    assert plan.expected_return.isnan().all()


def test_bad_input_is_one_clear_line(toy: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match=r"^segment_length must be at least 1, not 0$"):
        RandomPlanner(segment_length=0)
    with pytest.raises(ValueError, match=r"^one generator per environment: 1 needed, 2 given$"):
        RandomPlanner().plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(0, 1))
