"""Lists of additions, the user's own among them, and options that none of ours has."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest
from torch import Tensor, nan

from cavin_pyro.planning import Addition, CavinPlanner, MpcPlanner
from cavin_pyro.planning.additions import ADDITIONS, Choice, PerturbedRollouts, Touchdown
from cavin_pyro.planning.returns import prefer
from cavin_pyro.planning.searching import SearchingPlanner


class Gentle(Addition):
    """Leaves out all but the quarter of the candidates that push least."""

    def rank(self, scores: Tensor, choice: Choice) -> Tensor:
        farthest = choice.first_actions()[..., 2:].norm(dim=-1).amax(-1)
        return prefer(scores, farthest <= farthest.quantile(0.25, -1, keepdim=True))


class Gentler(Addition):
    """Lowers the scores of candidates that push far, in square metres."""

    def rank(self, scores: Tensor, choice: Choice) -> Tensor:
        return scores - choice.first_actions()[..., 2:].norm(dim=-1).amax(-1)


@pytest.mark.parametrize("own", [Gentle(), Gentler()])
@pytest.mark.parametrize("kind", [CavinPlanner, MpcPlanner])
@pytest.mark.parametrize("ours", [[], ["perturbed_rollouts"]])
def test_a_users_own_addition_changes_plans(
    toy: SimpleNamespace, own: Addition, kind: type[SearchingPlanner], ours: list
) -> None:
    state, reward, pushes = toy.scenes([[(0.0, 0.0)]] * 8), toy.GoalDisc(goal=(9.0, 0.0), dense=True), []
    for additions in (ours, [*ours, own]):
        planner = kind(toy.PointMass(noise=0.1), samples=256, horizon=6, additions=additions)
        plan = planner.plan(state, reward=reward, generators=toy.generators(*range(8)))
        pushes.append(plan.actions[..., 2:].norm(dim=-1).amax(-1).mean())
    assert pushes[1] < 0.9 * pushes[0]


@pytest.mark.parametrize("wrong", [lambda scores: scores[..., None], lambda scores: scores * nan])
def test_scores_of_another_shape_and_nan_are_refused(toy: SimpleNamespace, wrong: Callable) -> None:
    class Wrong(Addition):
        def rank(self, scores: Tensor, choice: Choice) -> Tensor:
            return wrong(scores)

    planner = CavinPlanner(toy.PointMass(), samples=4, horizon=6, additions=[Wrong()])
    state, reward = toy.scenes([[(0.0, 0.0)]]), toy.GoalDisc(goal=(9.0, 0.0), dense=True)
    with pytest.raises(ValueError, match=r"^Wrong\.rank must return shape \[1, 4\], not "):
        planner.plan(state, reward=reward, generators=toy.generators(0))


def test_additions_act_in_one_order_however_they_are_listed(toy: SimpleNamespace) -> None:
    given = [Touchdown(0.02), "guidance", Gentle(), *ADDITIONS.keys() - {"guidance", "touchdown"}]
    for listed in (given, given[::-1]):
        planner = CavinPlanner(toy.PointMass(), additions=listed)
        assert [type(addition) for addition in planner.additions] == [Gentle, *ADDITIONS.values()]


@pytest.mark.parametrize(
    ("additions", "message"),
    [
        (["touchup"], "^unknown addition 'touchup': choose from early_stopping, nearest_objects, "),
        ([Touchdown(0.02), "touchdown"], "^additions Touchdown, Touchdown: one of them is given twice$"),
        ([Gentle], r"^additions must be of type Sequence"),
        ("first_push", r"^additions must be of type .*, not 'first_push'$"),
        (["first_push"], "^FirstPush does nothing in this planner: leave it out$"),
        (["failure_avoidance"], "^FailureAvoidance does nothing in this planner: leave it out$"),
    ],
)
def test_what_is_no_addition_of_a_planner_is_refused(toy: SimpleNamespace, additions: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MpcPlanner(toy.PointMass(), additions=additions)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (Touchdown, {"distance": -0.1}, "distance must be a number of at least 0"),
        (PerturbedRollouts, {"failure_cost": float("nan")}, "failure_cost must be a number of at least 0"),
    ],
)
def test_bad_options_of_additions_are_one_clear_line(kind: type[Addition], options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        kind(**options)
