"""All optimizers, on problems whose optimum is known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from cavin_pyro.planning import CavinPlanner
from cavin_pyro.planning.optimizers import OPTIMIZERS, make_optimizer
from cavin_pyro.planning.optimizers.cem import coloured
from cavin_pyro.planning.returns import CumulativeReward
from cavin_pyro.planning.rollout import Candidates, SearchProblem
from cavin_pyro.planning.searching import search

TOP = (0.8, -0.6)
SAMPLES = 512
# Largest distance from the top per segment, the root of the mean square, with 512 samples of 6 numbers (3 segments).
# Of 20,000 independent draws of 512, 99.9 % come closer than 0.74.
TOLERANCE = {"shooting": 0.74, "smc": 0.45, "cem": 0.2, "icem": 0.2, "mppi": 0.2}
each_optimizer = pytest.mark.parametrize("name", sorted(OPTIMIZERS))


def problem_of(toy: SimpleNamespace, *seeds: int, segments: int = 3) -> SearchProblem:
    state = toy.scenes([[(0.0, 0.0)]] * len(seeds))
    return SearchProblem(toy.Placed(), CumulativeReward(toy.Hill(TOP)), state, toy.generators(*seeds), segments)


def optimized(toy: SimpleNamespace, name: str, *seeds: int, segments: int = 3, samples: int = SAMPLES) -> Candidates:
    return search(make_optimizer(name, samples=SAMPLES), problem_of(toy, *seeds, segments=segments), samples)


@each_optimizer
def test_the_optimum_is_reached_within_the_tolerance(toy: SimpleNamespace, name: str) -> None:
    best = optimized(toy, name, *range(16)).returns.max(-1).values
    assert ((-best / 3).sqrt() <= TOLERANCE[name]).all()


@pytest.mark.parametrize("name", sorted(OPTIMIZERS.keys() - {"shooting"}))
@pytest.mark.parametrize("segments", [1, 3, 10])
def test_the_others_find_more_than_shooting_with_the_same_samples(
    toy: SimpleNamespace, name: str, segments: int
) -> None:
    ours, theirs = (
        optimized(toy, one, *range(32), segments=segments).returns.max(-1).values.mean() for one in (name, "shooting")
    )
    assert ours > theirs


@each_optimizer
def test_no_optimizer_considers_more_than_its_samples(toy: SimpleNamespace, name: str) -> None:
    for segments in (1, 2, 7):
        asked: list[int] = []

        class Counting(toy.Placed):  # type: ignore[name-defined]
            def extend(self, segment: int, here: object, plans: object, *rest: object) -> object:
                asked.append(plans.batch_shape[-1])  # type: ignore[attr-defined]  # noqa: B023
                return super().extend(segment, here, plans, *rest)

        problem = replace(problem_of(toy, 0, segments=segments), space=Counting())
        search(make_optimizer(name, samples=SAMPLES), problem, 100)
        assert 0 < sum(asked) <= 100 * segments


@each_optimizer
def test_neither_order_nor_number_of_environments_matter(toy: SimpleNamespace, name: str) -> None:
    many = optimized(toy, name, 5, 6, 7, 8).returns
    shuffled = optimized(toy, name, 8, 5, 7, 6).returns
    torch.testing.assert_close(many[[3, 0, 2, 1]], shuffled)
    for number, seed in enumerate((5, 6, 7, 8)):
        torch.testing.assert_close(many[number : number + 1], optimized(toy, name, seed).returns)


@each_optimizer
def test_returns_that_are_not_finite_do_no_harm(toy: SimpleNamespace, name: str) -> None:
    class Broken(toy.Hill):  # type: ignore[name-defined]
        def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> object:
            judged = super().__call__(previous, centers, mask)
            return judged._replace(reward=judged.reward.masked_fill(centers[..., 0, 0] < 0, torch.nan))

    problem = problem_of(toy, 0, 1, segments=2)
    problem = replace(problem, objective=CumulativeReward(Broken(TOP)))
    found = search(make_optimizer(name, samples=SAMPLES), problem, SAMPLES)
    assert ((-found.returns.max(-1).values / 2).sqrt() < TOLERANCE[name]).all()


@each_optimizer
def test_an_optimizer_works_at_both_levels(toy: SimpleNamespace, name: str) -> None:
    # A goal too far to reach, straight ahead: the best is 0.15 m in each of four segments; motions follow.
    reward = toy.GoalDisc(goal=(10.0, 0.0), dense=True)
    planner = CavinPlanner(toy.PointMass(), samples=512, horizon=12, optimizer=name, additions=["failure_avoidance"])
    plan = planner.plan(toy.scenes([[(0.0, 0.0)]] * 4), reward=reward, generators=toy.generators(0, 1, 2, 3))
    progress = plan.expected_return + 12
    assert (progress <= 0.6).all()
    assert (progress >= 0.5).all()
    error = (plan.predicted_centers[:, 2::3] - plan.subgoals.centers).norm(dim=-1)
    assert (error < 0.04).all()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("cem", {"iterations": 1.5}, "iterations must be a whole number of at least 1, not 1.5"),
        ("icem", {"kept_elite_fraction": 2}, "kept_elite_fraction must be a number of at least 0 and at most 1, not 2"),
        ("icem", {"exponent": -1}, "exponent must be a number of at least 0 and at most 10, not -1"),
        ("smc", {"moves": -1}, "moves must be a whole number of at least 0, not -1"),
        ("smc", {"temperature": 0.0}, "temperature must be a number above 0, not 0.0"),
    ],
)
def test_bad_options_are_one_clear_line(name: str, options: dict, message: str) -> None:
    with pytest.raises(ValueError) as error:
        OPTIMIZERS[name](**options)
    assert str(error.value) == message


def test_what_is_no_optimizer_is_refused_in_one_line() -> None:
    choices = "shooting, cem, icem, mppi, smc"
    with pytest.raises(ValueError, match=f"^unknown optimizer 'best': choose from {choices}$"):
        make_optimizer("best", samples=SAMPLES)
    with pytest.raises(ValueError, match=rf"^optimizer must be one of {choices}, or an object with a method optimize"):
        make_optimizer(3, samples=SAMPLES)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="^4 iterations need at least as many samples .*, not 3$"):
        make_optimizer("mppi", samples=3)


@pytest.mark.parametrize("segments", [1, 2, 5])
@pytest.mark.parametrize("exponent", [0.5, 2.0])
def test_every_number_keeps_mean_zero_and_variance_one(segments: int, exponent: float) -> None:
    white = torch.randn(1, 40_000, segments, 1, generator=torch.Generator().manual_seed(0))
    noise = coloured(white, exponent)[0, ..., 0]
    torch.testing.assert_close(noise.mean(0), torch.zeros(segments), rtol=0, atol=0.03)
    torch.testing.assert_close(noise.var(0), torch.ones(segments), rtol=0, atol=0.04)
