"""Many environments are planned in chunks, and nobody can tell which."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest

from planning import CvaeMpcPlanner, Planner
from planning.backends import chunking
from tests.planning.conftest import same, tensors

FACTORIES: dict[str, Callable[[SimpleNamespace], Planner]] = {
    "cavin": lambda toy: toy.plain(toy.PointMass(), toy.GoalDisc(goal=(0.4, 0.0)), samples=32, horizon=9),
    "inference": lambda toy: toy.plain(
        toy.PointMass(), toy.GoalDisc(goal=(0.4, 0.0)), samples=32, horizon=9, optimizer="smc"
    ),
    "cvae_mpc": lambda toy: CvaeMpcPlanner(toy.Flat(), toy.GoalDisc(goal=(0.4, 0.0)), samples=32, horizon=9),
}


@pytest.mark.parametrize("size", [1, 2, 3, 5])
@pytest.mark.parametrize("name", FACTORIES)
def test_plans_do_not_depend_on_the_size_of_chunks(
    toy: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, name: str, size: int
) -> None:
    planner = FACTORIES[name](toy)
    state = toy.scenes([[(0.1 * number, 0.0)] for number in range(5)])
    at_once, generators = planner.plan(state, toy.generators(*range(5))), toy.generators(*range(5))
    monkeypatch.setattr(chunking, "ENVIRONMENTS_ON_PROCESSOR", size)
    in_chunks = planner.plan(state, generators)
    assert in_chunks.actions.shape == (5, 3, 4)
    assert all(same(*pair) for pair in zip(tensors(at_once), tensors(in_chunks), strict=True))


def test_a_chunk_holds_no_more_environments_than_it_should(
    toy: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = toy.PointMass()
    seen: list[int] = []
    subgoal = model.subgoal
    monkeypatch.setattr(model, "subgoal", lambda state, code: seen.append(len(code)) or subgoal(state, code))
    monkeypatch.setattr(chunking, "ENVIRONMENTS_ON_PROCESSOR", 2)
    planner = toy.plain(model, toy.GoalDisc(goal=(9.0, 9.0)), samples=8, horizon=3)
    planner.plan(toy.scenes([[(0.0, 0.0)]] * 5), toy.generators(*range(5)))
    assert seen == [2, 2, 1]


def test_a_hopeless_environment_is_named_by_its_number_in_the_whole_batch(
    toy: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunking, "ENVIRONMENTS_ON_PROCESSOR", 2)
    state = toy.scenes([[(0.0, 0.0)]] * 3 + [[(float("nan"), 0.0)]])
    with pytest.raises(ValueError, match=r"^environment 3: none of the 32 returns .* is finite"):
        FACTORIES["cavin"](toy).plan(state, toy.generators(*range(4)))
