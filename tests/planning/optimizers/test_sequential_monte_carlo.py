"""Planning as inference samples the distribution that it claims to sample."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from planning.optimizers import SequentialMonteCarlo, search
from planning.optimizers.sequential_monte_carlo import active_returns
from planning.rollouts.candidates import Candidates, SearchProblem
from planning.rollouts.cumulative_reward import CumulativeReward

TOP = (0.8, -0.6)


def begun(toy: SimpleNamespace, count: int, segments: int = 2) -> Candidates:
    problem = SearchProblem(
        toy.Placed(), CumulativeReward(toy.Hill(TOP)), toy.scenes([[(0.0, 0.0)]]), toy.generators(0), segments
    )
    return problem.evaluate(problem.noise(count))


def test_moves_without_a_reward_leave_the_prior_as_it_is(toy: SimpleNamespace) -> None:
    particles = begun(toy, 20_000)
    for _ in range(3):
        particles, proposed = SequentialMonteCarlo(step=0.7)._move(particles, torch.zeros(1))
        assert torch.equal(particles.noise, proposed.noise)  # nothing to refuse a proposal for
    moments = particles.noise.mean(1), particles.noise.std(1)
    for moment, expected in zip(moments, (0.0, 1.0), strict=True):
        torch.testing.assert_close(moment, torch.full_like(moment, expected), rtol=0, atol=0.03)


@pytest.mark.parametrize("block", [1, 2])
def test_moves_lead_to_the_posterior(toy: SimpleNamespace, block: int) -> None:
    # N(0, 1) times exp(-2 |x - top|^2) is N(0.8 top, 0.2).
    particles, inverse = begun(toy, 10_000), torch.tensor([2.0])
    for _ in range(40):
        particles, _ = SequentialMonteCarlo(step=0.5, block=block)._move(particles, inverse)
    last = particles.noise[0, :, -block:]  # what the moves touch
    expected = 0.8 * torch.tensor(TOP)
    torch.testing.assert_close(last.mean(0), expected.expand(block, 2), rtol=0, atol=0.03)
    torch.testing.assert_close(last.var(0), torch.full((block, 2), 0.2), rtol=0, atol=0.02)
    if block == 1:
        assert torch.equal(particles.noise[:, :, 0], begun(toy, 10_000).noise[:, :, 0])


def test_resampling_and_moves_together_draw_from_the_posterior_of_some_temperature(toy: SimpleNamespace) -> None:
    # With inverse temperature b each number is N(2 b / (1 + 2 b) top, 1 / (1 + 2 b)): mean / top = 1 - variance.
    problem = SearchProblem(
        toy.Placed(), CumulativeReward(toy.Hill(TOP)), toy.scenes([[(0.0, 0.0)]]), toy.generators(0), 2
    )
    step = 0.5
    found = search(SequentialMonteCarlo(effective_sample_size=0.5, moves=10, step=step), problem, 20_000 * 16)
    proposed = found.noise[0, -20_000:]  # by the last move, from x: sqrt(1 - step^2) x + step N(0, 1)
    mean, variance = proposed.mean(0) / (1 - step**2) ** 0.5, (proposed.var(0) - step**2) / (1 - step**2)
    assert ((variance > 0.2) & (variance < 0.8)).all()
    torch.testing.assert_close(mean / torch.tensor(TOP), 1 - variance, rtol=0, atol=0.05)


def test_failed_particles_are_replaced_by_copies_of_active_ones(toy: SimpleNamespace) -> None:
    reward = toy.GoalDisc(goal=(9.0, 9.0), forbidden_below=0.0)
    problem = SearchProblem(toy.Placed(), CumulativeReward(reward), toy.scenes([[(0.0, 0.1)]]), toy.generators(0), 4)
    found = search(SequentialMonteCarlo(moves=0), problem, 400)
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
    none = Candidates(
        candidates.problem, candidates.plans, score_state._replace(failed=torch.ones(1, 3, dtype=torch.bool))
    )
    assert active_returns(none).tolist() == [[-1.0, -2.0, -torch.inf]]


@pytest.mark.parametrize(("segments", "moves", "particles"), [(1, 0, 100), (1, 1, 50), (2, 1, 40), (10, 1, 34)])
def test_moves_cost_particles(segments: int, moves: int, particles: int) -> None:
    assert SequentialMonteCarlo(moves=moves, block=2).particles(100, segments) == particles
