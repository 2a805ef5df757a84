"""Sequential Monte Carlo estimates Z = E[exp(return / temperature)] without bias, where Z is known in closed form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from models.state import State
from planning.optimizers import LastPlan, SequentialMonteCarlo, search
from planning.optimizers import sequential_monte_carlo as module
from planning.optimizers.proposals import propose
from planning.plan import Evidence
from planning.rollouts.candidates import SearchProblem
from planning.rollouts.cumulative_reward import CumulativeReward
from planning.rollouts.sampling import noise_each
from planning.rollouts.segment import SegmentRollout

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


class Shifted:
    """A proposal that leads away from the top, and too wide along one axis."""

    def __call__(self, segment: int, plans: State, noise: Tensor, warm_start: Tensor | None) -> Distribution:
        mean = torch.tensor([-0.4, 0.3]).expand(len(noise), 2)
        return Independent(Normal(mean, torch.tensor([1.5, 0.9]).expand(len(noise), 2)), 1)


def wrong_value(segment: int, plans: State) -> Tensor:
    """A value that has nothing to do with the return."""
    return 0.7 * torch.sin(3 * plans.centers[..., 0, 0]) - segment


def problem_of(toy: SimpleNamespace, runs: int = RUNS, segments: int = SEGMENTS, **options: Any) -> SearchProblem:
    state = toy.scenes([[(0.0, 0.0)]] * runs)
    objective = options.pop("objective", CumulativeReward(toy.Hill(TOP)))
    space = options.pop("space", Walk())
    return SearchProblem(space, objective, state, toy.generators(*range(runs)), segments, **options)


def warm_start(runs: int = RUNS, plans: int = 4, dimension: int = 2) -> Tensor:
    """`[runs, plans, K, D]`: noise of an earlier plan, the same in every run."""
    one = torch.randn(plans, SEGMENTS, dimension, generator=torch.Generator().manual_seed(7))
    return one.expand(runs, -1, -1, -1)


def estimate(problem: SearchProblem, samples: int = SAMPLES, **options: Any) -> Evidence:
    search(SequentialMonteCarlo(**{"temperature": 1.0, **options}), problem, samples)
    (evidence,) = problem.evidence
    return evidence


def deviation(log_estimates: Tensor, expected: float) -> tuple[float, float]:
    """Mean of Z's estimates over Z, minus 1, in standard errors; and the standard error."""
    ratios = (log_estimates - expected).exp()
    error = float(ratios.std() / math.sqrt(len(ratios)))
    return (float(ratios.mean()) - 1.0) / error, error


CASES: dict[str, dict[str, Any]] = {
    "as it is": {},
    "no moves": {"moves": 0},
    "moves of all segments": {"moves": 2, "block": SEGMENTS, "step": 0.9},
    "linear schedule": {"schedule": "linear"},
    "resampled when needed": {"resample_below": 0.5},
    "near the last plan": {"proposal": LastPlan(prior_fraction=0.4, correlation=0.6)},
    "near the last plan, resampled when needed": {"proposal": "last_plan", "resample_below": 0.3},
    "a bad proposal": {"proposal": Shifted()},
    "a wrong value": {"value": wrong_value},
    "all at once": {"proposal": "last_plan", "value": wrong_value, "schedule": "linear", "resample_below": 0.6},
}


OFTEN = ("as it is", "moves of all segments", "linear schedule", "a bad proposal")


@pytest.mark.parametrize(
    "case", [case if case in OFTEN else pytest.param(case, marks=pytest.mark.soak) for case in CASES]
)
def test_the_estimate_of_z_is_unbiased(toy: SimpleNamespace, case: str) -> None:
    evidence = estimate(problem_of(toy, warm_start=warm_start()), **CASES[case])
    off, error = deviation(evidence.log_evidence, log_z(1.0))
    assert error < 0.03  # of Z
    assert abs(off) < 3.5


def without_ratio(proposal: Any, candidates: Any) -> tuple[Tensor, Tensor]:
    noise, ratios = propose(proposal, candidates)
    return noise, torch.zeros_like(ratios)


@pytest.mark.parametrize("proposal", [pytest.param("last_plan", marks=pytest.mark.soak), Shifted()])
def test_weights_without_prior_over_proposal_are_found_out(
    toy: SimpleNamespace, proposal: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "propose", without_ratio)
    evidence = estimate(problem_of(toy, warm_start=warm_start()), proposal=proposal)
    assert abs(deviation(evidence.log_evidence, log_z(1.0))[0]) > 10


def test_a_value_that_is_not_divided_out_is_found_out(toy: SimpleNamespace) -> None:
    class Kept(SequentialMonteCarlo):
        def _scores(self, candidates: Any) -> Tensor:
            scores = super()._scores(candidates)
            last = len(candidates.segments) == SEGMENTS
            return scores + wrong_value(SEGMENTS, candidates.plans) if last else scores

    problem = problem_of(toy)
    search(Kept(temperature=1.0, value=wrong_value), problem, SAMPLES)
    assert abs(deviation(problem.evidence[0].log_evidence, log_z(1.0))[0]) > 10


def test_an_adaptive_temperature_is_reported_and_its_estimate_is_near_the_z_of_that_temperature(
    toy: SimpleNamespace,
) -> None:
    evidence = estimate(problem_of(toy, runs=20), 4000, temperature=None)
    assert len(evidence.temperature.unique()) > 1  # every run has its own, so Z differs as well
    known = torch.tensor([log_z(1 / temperature) for temperature in evidence.temperature.tolist()])
    torch.testing.assert_close(evidence.log_evidence.float(), known, rtol=0, atol=0.3)


@pytest.mark.soak
def test_weighted_plans_have_the_moments_of_the_posterior(toy: SimpleNamespace) -> None:
    # Unbiased is not only Z but also Z times the mean of a function of the resampled plans, here their last noise.
    problem = problem_of(toy, warm_start=warm_start())
    step = 0.4
    found = search(SequentialMonteCarlo(temperature=1.0, step=step, proposal="last_plan"), problem, SAMPLES)
    proposed = found.noise[:, found.count // 2 :, -1, :]  # sqrt(1 - step^2) x + step N(0, 1)
    z = (problem.evidence[0].log_evidence - log_z(1.0)).exp().unsqueeze(-1)
    means = z * proposed.mean(1) / math.sqrt(1 - step**2)
    # Posterior of the noise: precision I + 2 L^T L, mean precision^-1 2 L^T top.
    steps = torch.ones(SEGMENTS, SEGMENTS).tril()
    precision = torch.eye(SEGMENTS) + 2 * steps.T @ steps
    expected = torch.linalg.solve(precision, 2 * steps.T @ torch.ones(SEGMENTS))[-1] * torch.tensor(TOP)
    error = means.std(0) / math.sqrt(RUNS)
    assert (error < 0.02).all()
    assert ((means.mean(0) - expected).abs() < 3.5 * error).all()


def test_the_best_proposal_and_the_best_value_give_z_with_a_single_particle(toy: SimpleNamespace) -> None:
    inverse = 2.0
    top = torch.tensor(TOP)

    class Best:
        def __call__(self, segment: int, plans: State, noise: Tensor, warm_start: Tensor | None) -> Distribution:
            later = attraction(SEGMENTS - segment - 1, inverse)[1] if segment + 1 < SEGMENTS else 0.0
            pull = 2 * (inverse + later)
            mean = pull * (top - plans.centers[..., 0, :2]) / (1 + pull)
            return Independent(Normal(mean, torch.full_like(mean, (1 + pull) ** -0.5)), 1)

    def best(segment: int, plans: State) -> Tensor:
        first, second = attraction(SEGMENTS - segment, inverse)
        return (first - second * (plans.centers[..., 0, :2] - top).square().sum(-1)) / inverse

    options: dict[str, Any] = {"temperature": 1 / inverse, "moves": 0, "proposal": Best(), "value": best}
    for particles in (1, 10):
        evidence = estimate(problem_of(toy, runs=5), particles, **options)
        known = torch.full((5,), log_z(inverse), dtype=torch.float64)
        torch.testing.assert_close(evidence.log_evidence, known, rtol=0, atol=1e-4)
        torch.testing.assert_close(
            evidence.effective_samples, torch.full((5, SEGMENTS), float(particles), dtype=torch.float64)
        )
        assert (evidence.particles == particles).all()
    without = estimate(problem_of(toy, runs=5), 10, **{**options, "value": None})
    assert without.log_evidence.std() > 0.01


@pytest.mark.soak
def test_ended_plans_count_once_and_failures_keep_their_return(toy: SimpleNamespace) -> None:
    # A segment fails with probability 1/2 (below the line), else succeeds within the disc's upper half, else goes on.
    # A failure within the disc's lower half earns both rewards, -1 in total.
    radius, temperature = 0.5, 60.0
    reward = toy.GoalDisc((0.0, 0.0), radius=radius, forbidden_below=0.0)
    succeeds = 0.5 * (1 - math.exp(-(radius**2) / 2))
    known = 1.0
    for _ in range(SEGMENTS):
        earned = {99.0: succeeds, -1.0: succeeds, -101.0: 0.5 - succeeds}
        ends = sum(share * math.exp(total / temperature) for total, share in earned.items())
        known = ends + (0.5 - succeeds) * math.exp(-1 / temperature) * known
    problem = problem_of(toy, space=toy.Placed(), objective=CumulativeReward(reward), warm_start=warm_start())
    evidence = estimate(problem, temperature=temperature, proposal="last_plan")
    off, error = deviation(evidence.log_evidence, math.log(known))
    assert error < 0.03
    assert abs(off) < 3.5


@pytest.mark.parametrize("inverse", [0.2, 1.0])
def test_the_effective_sample_size_is_that_of_the_known_weights(toy: SimpleNamespace, inverse: float) -> None:
    # n E[w]^2 / E[w^2] with w = exp(inverse * return)
    evidence = estimate(problem_of(toy, runs=20, segments=1), 20_000, temperature=1 / inverse, moves=0)
    expected = 20_000 * math.exp(2 * log_z(inverse, 1) - log_z(2 * inverse, 1))
    assert evidence.effective_samples.shape == (20, 1)
    torch.testing.assert_close(evidence.effective_samples.mean().item(), expected, rtol=0.02, atol=0)


def test_effective_samples_are_all_or_one_where_weights_are_equal_or_hopelessly_unequal(toy: SimpleNamespace) -> None:
    warm = estimate(problem_of(toy, runs=3), temperature=1e6)
    assert (warm.effective_samples > 0.999 * warm.particles.unsqueeze(-1)).all()
    assert (warm.log_evidence.abs() < 1e-3).all()
    cold = estimate(problem_of(toy, runs=3), temperature=1e-6)
    assert ((cold.effective_samples >= 1) & (cold.effective_samples < 1.1)).all()


def test_where_no_return_is_finite_z_is_zero(toy: SimpleNamespace) -> None:
    class Nothing(toy.Hill):  # type: ignore[name-defined]
        def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> object:
            judged = super().__call__(previous, centers, mask)
            return judged._replace(reward=torch.full_like(judged.reward, torch.nan))

    for options in ({}, {"resample_below": 0.5}, {"temperature": None}):
        evidence = estimate(problem_of(toy, runs=2, objective=CumulativeReward(Nothing(TOP))), **options)
        assert (evidence.log_evidence == -torch.inf).all()
        assert (evidence.effective_samples == 0).all()


def test_relabelled_particles_and_plans_of_the_warm_start_have_the_same_densities(toy: SimpleNamespace) -> None:
    problem = problem_of(toy, runs=1, warm_start=warm_start(1))
    candidates = problem.begin(6)
    for segment in noise_each((2, 6, 2), problem.generators).unbind(1):
        candidates = candidates.extend(segment)
    order, others = torch.tensor([3, 0, 5, 1, 4, 2]), torch.tensor([2, 0, 3, 1])
    at = torch.randn(6, 2, generator=torch.Generator().manual_seed(1))

    def density(numbers: Sequence[int], plans: Tensor) -> Tensor:
        noise = candidates.take(torch.as_tensor(numbers)[None]).noise[0]
        found = LastPlan()(2, candidates.plans.scene(0), noise, plans)
        assert found is not None
        return found.log_prob(at[torch.as_tensor(numbers)])

    plain = density(range(6), warm_start(1)[0])
    torch.testing.assert_close(density(order.tolist(), warm_start(1)[0]), plain[order])
    torch.testing.assert_close(density(range(6), warm_start(1)[0][others]), plain)


def test_relabelled_environments_and_obstacles_have_the_same_evidence(toy: SimpleNamespace) -> None:
    reward = toy.GoalDisc((0.3, 0.1), forbidden_below=-0.2)
    optimizer = SequentialMonteCarlo(temperature=30.0, proposal="last_plan")
    planner = toy.plain(toy.PointMass(), reward, samples=100, horizon=9, optimizer=optimizer, warm_start=True)
    places = [[(0.0, 0.0), (0.1, -0.15), (0.5, 0.2)], [(0.1, 0.1), (0.2, 0.0), (0.4, -0.1)]]

    def evidence(order: list[int], environments: list[int]) -> Evidence:
        scenes = toy.scenes([[places[number][one] for one in order] for number in environments], [1.0] * 3)
        generators = toy.generators(*environments)
        plan = planner.plan(scenes, generators, planner.plan(scenes, generators))
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


def test_only_inference_gives_plans_evidence(toy: SimpleNamespace) -> None:
    for optimizer in ("shooting", "cem", "smc"):
        planner = toy.plain(toy.PointMass(), toy.GoalDisc((0.3, 0.0)), samples=50, horizon=6, optimizer=optimizer)
        plan = planner.plan(toy.scenes([[(0.0, 0.0)]]), toy.generators(0))
        assert (plan.evidence is not None) == (optimizer == "smc")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"temperature": 0.0}, "temperature must be a positive number or null, not 0.0"),
        ({"temperature": math.inf}, "temperature must be a positive number or null, not inf"),
        ({"temperature": 1.0, "schedule": "steep"}, "unknown schedule 'steep': choose constant or linear"),
        ({"schedule": "linear"}, "schedule=linear needs a temperature: without one, it adapts"),
        ({"resample_below": 0.0}, "resample_below must be above 0 and at most 1, not 0.0"),
        ({"proposal": "guide"}, "unknown proposal 'guide': choose prior or last_plan"),
        ({"value": 3}, "value must be a Value or null, not 3"),
        ({"proposal": 3}, "proposal must be prior, last_plan or a NoiseProposal, not 3"),
    ],
)
def test_bad_options_are_one_clear_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as error:
        SequentialMonteCarlo(**options)
    assert str(error.value) == message


def test_bad_mixtures_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^prior_fraction must be above 0 and at most 1, not 0$"):
        LastPlan(prior_fraction=0)
    with pytest.raises(ValueError, match=r"^correlation must be at least 0 and below 1, not 1$"):
        LastPlan(correlation=1)


def test_proposals_and_values_of_wrong_shapes_are_refused_in_one_line(toy: SimpleNamespace) -> None:
    def flat(segment: int, plans: State, noise: Tensor, warm_start: Tensor | None) -> Distribution:
        return Normal(torch.zeros(2), 1.0)

    with pytest.raises(ValueError, match=r"function must give a distribution of batch \[n\] = \[10\] and event \[D\]"):
        estimate(problem_of(toy, runs=1), 10, moves=0, proposal=flat)
    with pytest.raises(ValueError, match=r"a value must be finite, of shape \[B, n\] = \[1, 10\]$"):
        estimate(
            problem_of(toy, runs=1), 10, moves=0, value=lambda segment, plans: plans.centers[..., 0, 0] * torch.nan
        )


def test_the_last_plan_is_kept_beside_the_particles_and_leaves_the_estimate_alone(toy: SimpleNamespace) -> None:
    known = warm_start(2)
    kept, without = (problem_of(toy, runs=2, warm_start=known) for _ in range(2))
    found = search(SequentialMonteCarlo(temperature=1.0, keep_last_plan=True), kept, SAMPLES + 4)
    assert torch.equal(found.noise[:, -4:], known)
    assert found.count == search(SequentialMonteCarlo(temperature=1.0), without, SAMPLES).count + 4
    for ours, theirs in zip(kept.evidence[0], without.evidence[0], strict=True):
        assert torch.equal(ours, theirs)
    few = problem_of(toy, runs=2, warm_start=known)
    assert search(SequentialMonteCarlo(moves=0, keep_last_plan=True), few, 4).count == 4  # 2 particles, 2 kept


def test_without_a_warm_start_the_last_plans_proposal_is_the_prior(toy: SimpleNamespace) -> None:
    problem = problem_of(toy, runs=2)
    with_prior, without = (
        estimate(replace(problem, generators=toy.generators(0, 1)), proposal=proposal)
        for proposal in ("prior", "last_plan")
    )
    assert torch.equal(with_prior.log_evidence, without.log_evidence)
