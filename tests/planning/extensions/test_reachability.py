"""Effects that no motion brings about lose, if so wanted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from models.state import State
from planning import Plan, Reachability
from planning.optimizers import Shooting

# By h both of the first two plans pass x = 1 in their fourth step: 0.5 + 0.625 and 0.375 + 0.75.
EFFECTS = [[0.5, 0.375, -0.25], [0.625, 0.75, 0.0]]


def planned(toy: SimpleNamespace, reachability: Reachability | None, *, half: float, seed: int = 0) -> Plan:
    """Pushes for an effect of `half` go half the way that they should; motion codes hardly matter."""

    class Sticky(toy.Tabled):  # type: ignore[name-defined]
        def motion_prior(self, state: State, effect_code: Tensor) -> Distribution:
            return Independent(Normal(torch.zeros(*effect_code.shape[:-1], 16), 1e-4), 1)

        def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
            pushes = super().actions(state, effect_code, motion_code)
            return torch.where((effect_code[..., 0] == half)[..., None, None], 0.5 * pushes, pushes)

    options: dict[str, Any] = {"optimizer": Shooting(replacement=False), "motion_horizon": "first_segment"}
    model = Sticky(EFFECTS, [])
    planner = toy.plain(model, toy.Line(), samples=3, horizon=4, reachability=reachability, **options)
    return planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(seed))


def test_of_equal_promises_the_one_that_motions_keep_is_chosen(toy: SimpleNamespace) -> None:
    for half, first in ((0.5, 0.375), (0.375, 0.5)):
        plan = planned(toy, Reachability(candidates=3, motions=4), half=half)
        assert plan.effect_codes[0, 0, 0] == first
        assert plan.subgoals.centers[0, :, 0, 0].tolist() == [first, 1.125]  # as h says
        assert plan.expected_return.tolist() == [-3.0 + 99.0]


def test_without_it_the_first_of_equals_is_chosen_whatever_motions_do(toy: SimpleNamespace) -> None:
    assert planned(toy, None, half=0.5).effect_codes[0, 0, 0] == 0.5


def test_only_finalists_are_looked_at(toy: SimpleNamespace) -> None:
    assert planned(toy, Reachability(candidates=1), half=0.5).effect_codes[0, 0, 0] == 0.5


def test_of_equal_returns_the_closest_is_chosen(toy: SimpleNamespace) -> None:
    # A goal out of reach: all plans get the same, and only the effect of -0.25 is kept by motions.
    class Shy(toy.PointMass):  # type: ignore[name-defined]
        def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
            pushes = super().actions(state, effect_code, 0 * motion_code)
            return torch.where((effect_code[..., 0] > 0)[..., None, None], 0.5 * pushes, pushes)

    planner = toy.plain(Shy(), toy.GoalDisc((9.0, 9.0)), samples=64, horizon=6, reachability=Reachability(64, 2))
    plan = planner.plan(toy.scenes([[(0.0, 0.0)]] * 4), toy.generators(0, 1, 2, 3))
    assert (plan.effect_codes[:, 0, 0] <= 0).all()


def test_it_repeats_with_its_seed_and_does_not_depend_on_the_batch(toy: SimpleNamespace) -> None:
    reward = toy.GoalDisc((0.25, 0.05), forbidden_below=0.0)
    planner = toy.plain(toy.PointMass(), reward, samples=64, horizon=6, reachability=Reachability(16, 8))
    state = toy.scenes([[(0.0, 0.02)], [(0.0, 0.2)]])
    both = planner.plan(state, toy.generators(1, 2))
    alone = planner.plan(state.scene(slice(1, 2)), toy.generators(2))
    assert torch.equal(both.actions[1], alone.actions[0])


@pytest.mark.parametrize("name", ["candidates", "motions"])
def test_counts_below_one_are_one_clear_line(name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name} must be at least 1, not 0$"):
        Reachability(**{name: 0})


def test_rescoring_many_plans_disables_early_stopping(toy: SimpleNamespace) -> None:
    def successes(reachability: Reachability | None) -> Tensor:
        reward = toy.GoalDisc(goal=(0.2, 0.0))
        planner = toy.plain(
            toy.PointMass(), reward, samples=256, horizon=12, warm_start=True, reachability=reachability
        )
        returns = planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(0)).candidate_returns
        return returns[returns > 0.0]

    alone, many = successes(None), successes(Reachability(4, 2))
    assert alone.max() == many.max()
    assert alone.min() > alone.max() - 3.0  # all of the segment in which the first one succeeds
    assert many.min() < many.max() - 3.0
