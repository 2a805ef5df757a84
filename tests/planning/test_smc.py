"""Sequential Monte Carlo estimates Z = E[exp(return / temperature)] without bias, where Z is known in closed form."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from cavin_pyro.models.state import State
from cavin_pyro.planning import CavinPlanner
from cavin_pyro.planning.optimizers import SMC
from cavin_pyro.planning.optimizers.smc import active_returns
from cavin_pyro.planning.protocol import Evidence, SegmentRollout
from cavin_pyro.planning.returns import CumulativeReward
from cavin_pyro.planning.rollout import Candidates, SearchProblem
from cavin_pyro.planning.searching import search

TOP = (0.8, -0.6)
SEGMENTS = 3
RUNS = 1000  # independent estimates, one per environment
SAMPLES = 80  # 30 particles with one move


class Walk:
    """A linear-Gaussian search space: every segment moves the target by its noise, in metres along x and y."""

    dimension = 2

    def extend(self, segment: int, here: State, plans: State, noise: Tensor, generators: object) -> SegmentRollout:
        centers = plans.centers.clone()
        centers[..., 0, :2] += noise
        states = plans._replace(centers=centers)
        return SegmentRollout(noise, None, states, centers.unsqueeze(-3))


def attraction(segments: int, inverse: float) -> tuple[float, float]:
    """log Z of a walk from x is `first - second |x - top|^2`, for returns of minus the squared distances to the top."""
    steps = torch.ones(segments, segments, dtype=torch.float64).tril()
    spread = torch.eye(segments, dtype=torch.float64) + 2 * inverse * steps @ steps.T
    ones = torch.ones(segments, dtype=torch.float64)
    second = inverse * ones @ torch.linalg.solve(spread, ones)
    return -float(torch.logdet(spread)), float(second)  # for two axes


def log_z(inverse: float, segments: int = SEGMENTS) -> float:
    """Of a walk from the origin."""
    first, second = attraction(segments, inverse)
    return first - second * (TOP[0] ** 2 + TOP[1] ** 2)


def problem_of(toy: SimpleNamespace, runs: int = RUNS, segments: int = SEGMENTS, **options: Any) -> SearchProblem:
    state = toy.scenes([[(0.0, 0.0)]] * runs)
    objective = options.pop("objective", CumulativeReward(toy.Hill(TOP)))
    space = options.pop("space", Walk())
    return SearchProblem(space, objective, state, toy.generators(*range(runs)), segments, **options)


def estimate(problem: SearchProblem, samples: int = SAMPLES, **options: Any) -> Evidence:
    search(SMC(**{"temperature": 1.0, **options}), problem, samples)
    (evidence,) = problem.evidence
    return evidence


def deviation(log_estimates: Tensor, expected: float) -> tuple[float, float]:
    """Mean of Z's estimates over Z, minus 1, in standard errors; and the standard error."""
    ratios = (log_estimates - expected).exp()
    error = float(ratios.std() / math.sqrt(len(ratios)))
    return (float(ratios.mean()) - 1.0) / error, error


CASES: dict[str, dict[str, Any]] = {
    "as it is": {},
    "moves of all segments": {"moves": 2, "block": SEGMENTS, "step": 0.9},
    "without moves": {"moves": 0},
}


@pytest.mark.parametrize("case", CASES)
def test_the_estimate_of_z_is_unbiased(toy: SimpleNamespace, case: str) -> None:
    evidence = estimate(problem_of(toy), **CASES[case])
    off, error = deviation(evidence.log_evidence, log_z(1.0))
    assert error < 0.03  # of Z
    assert abs(off) < 3.5
    assert abs(deviation(evidence.log_evidence, log_z(1.2))[0]) > 10  # another Z is found out


def test_where_no_return_is_finite_z_is_zero(toy: SimpleNamespace) -> None:
    class Nothing(toy.Hill):  # type: ignore[name-defined]
        def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> object:
            judged = super().__call__(previous, centers, mask)
            return judged._replace(reward=torch.full_like(judged.reward, torch.nan))

    for options in ({}, {"temperature": None}):
        evidence = estimate(problem_of(toy, runs=2, objective=CumulativeReward(Nothing(TOP))), **options)
        assert (evidence.log_evidence == -torch.inf).all()
        assert (evidence.effective_samples == 0).all()


def test_relabelled_environments_and_obstacles_have_the_same_evidence(toy: SimpleNamespace) -> None:
    reward = toy.GoalDisc((0.3, 0.1), forbidden_below=-0.2)
    optimizer = SMC(temperature=30.0)
    planner = CavinPlanner(toy.PointMass(), samples=100, horizon=9, optimizer=optimizer)
    places = [[(0.0, 0.0), (0.1, -0.15), (0.5, 0.2)], [(0.1, 0.1), (0.2, 0.0), (0.4, -0.1)]]

    def evidence(order: list[int], environments: list[int]) -> Evidence:
        scenes = toy.scenes([[places[number][one] for one in order] for number in environments], [1.0] * 3)
        plan = planner.plan(scenes, reward=reward, generators=toy.generators(*environments))
        assert plan.evidence is not None
        return plan.evidence

    plain = evidence([0, 1, 2], [0, 1])
    assert plain.log_evidence.shape == plain.temperature.shape == plain.particles.shape == (2,)
    assert plain.effective_samples.shape == (2, 3)
    assert plain.temperature.tolist() == [30.0, 30.0]
    for other, back in ((evidence([0, 2, 1], [0, 1]), [0, 1]), (evidence([0, 1, 2], [1, 0]), [1, 0])):
        for ours, theirs in zip(plain, other, strict=True):
            torch.testing.assert_close(ours, theirs[back])
    assert plain.log_evidence[0] != plain.log_evidence[1]


def begun(toy: SimpleNamespace, count: int, segments: int = 2) -> Candidates:
    problem = SearchProblem(
        toy.Placed(), CumulativeReward(toy.Hill(TOP)), toy.scenes([[(0.0, 0.0)]]), toy.generators(0), segments
    )
    return problem.evaluate(problem.noise(count))


def test_moves_without_a_reward_leave_the_prior_as_it_is(toy: SimpleNamespace) -> None:
    particles = begun(toy, 20_000)
    for _ in range(3):
        particles, proposed = SMC(step=0.7)._move(particles, torch.zeros(1))
        assert torch.equal(particles.noise, proposed.noise)  # nothing to refuse a proposal for
    moments = particles.noise.mean(1), particles.noise.std(1)
    for moment, expected in zip(moments, (0.0, 1.0), strict=True):
        torch.testing.assert_close(moment, torch.full_like(moment, expected), rtol=0, atol=0.03)


@pytest.mark.parametrize("block", [1, 2])
def test_moves_lead_to_the_posterior(toy: SimpleNamespace, block: int) -> None:
    # N(0, 1) times exp(-2 |x - top|^2) is N(0.8 top, 0.2).
    particles, inverse = begun(toy, 10_000), torch.tensor([2.0])
    for _ in range(40):
        particles, _ = SMC(step=0.5, block=block)._move(particles, inverse)
    last = particles.noise[0, :, -block:]  # what the moves touch
    expected = 0.8 * torch.tensor(TOP)
    torch.testing.assert_close(last.mean(0), expected.expand(block, 2), rtol=0, atol=0.03)
    torch.testing.assert_close(last.var(0), torch.full((block, 2), 0.2), rtol=0, atol=0.02)
    if block == 1:
        assert torch.equal(particles.noise[:, :, 0], begun(toy, 10_000).noise[:, :, 0])


def test_failed_particles_are_replaced_by_copies_of_active_ones(toy: SimpleNamespace) -> None:
    reward = toy.GoalDisc(goal=(9.0, 9.0), forbidden_below=0.0)
    problem = SearchProblem(toy.Placed(), CumulativeReward(reward), toy.scenes([[(0.0, 0.1)]]), toy.generators(0), 4)
    found = search(SMC(moves=0), problem, 400)
    assert found.count == 400
    firsts = found.noise[0, :, :-1, 1]
    assert (firsts >= 0).all()  # half of the samples of each segment are not
    assert len(found.noise[0, :, 0, 0].unique()) < 300
    assert found.score_state.failed.any()  # of the last segment


def test_successful_particles_stay_and_failed_ones_stay_where_all_have_failed(toy: SimpleNamespace) -> None:
    candidates = begun(toy, 3)
    score_state = candidates.score_state._replace(
        returns=torch.tensor([[-1.0, -2.0, -torch.inf]]),
        failed=torch.tensor([[True, False, True]]),
        succeeded=torch.tensor([[False, True, False]]),
    )
    some = Candidates(candidates.problem, candidates.plans, score_state)
    assert active_returns(some).tolist() == [[-torch.inf, -2.0, -torch.inf]]
    all_failed = score_state._replace(failed=torch.ones(1, 3, dtype=torch.bool))
    none = Candidates(candidates.problem, candidates.plans, all_failed)
    assert active_returns(none).tolist() == [[-1.0, -2.0, -torch.inf]]


@pytest.mark.parametrize(("segments", "moves", "particles"), [(1, 0, 100), (1, 1, 50), (2, 1, 40), (10, 1, 34)])
def test_moves_cost_particles(segments: int, moves: int, particles: int) -> None:
    assert SMC(moves=moves, block=2).particles(100, segments) == particles
