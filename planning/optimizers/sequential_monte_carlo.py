"""Planning as inference by sequential Monte Carlo, segment by segment.

Plans are sampled from p(plan) exp(return / temperature): the learned prior, weighted by their returns (Levine
2018; Piche et al., ICLR 2019). Resampling and moves as in Del Moral, Doucet and Jasra (2006), moves that leave the
prior invariant as in Cotter et al. (2013), "preconditioned Crank-Nicolson".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from planning.inputs import check_fraction, check_positive
from planning.optimizers.weights import adapt_temperature
from planning.rollouts.candidates import Candidates, SearchProblem, join
from planning.rollouts.sampling import noise_each, uniform_each


@dataclass(frozen=True)
class SequentialMonteCarlo:
    """Extends, weights, resamples and moves particles, a segment at a time.

    effective_sample_size: the temperature after a segment is the lowest at which the weights' effective sample size is
    this fraction of the particles that have not failed. moves: of every particle after every segment. block:
    last segments that a move changes. step: of a move, in (0, 1]; 1 samples independently of the current value.

    Extending n particles over K segments and moving their last ones costs as much as N samples of shooting.

    Raises ValueError for a block below 1, fewer than 0 moves and fractions outside of their range.
    """

    effective_sample_size: float = 0.3
    moves: int = 1
    block: int = 2
    step: float = 0.4

    def __post_init__(self) -> None:
        check_fraction("effective_sample_size", self.effective_sample_size, positive=True)
        if self.moves < 0:
            raise ValueError(f"moves must be at least 0, not {self.moves}")
        check_positive("block", self.block)
        check_fraction("step", self.step, positive=True)

    def particles(self, samples: int, segments: int) -> int:
        """n, for which extending and moving costs at most N = `samples` whole plans; at least 1."""
        moved = sum(min(number, self.block) for number in range(1, segments + 1))
        return max(1, samples * segments // (segments + self.moves * moved))

    def optimize(self, problem: SearchProblem, samples: int) -> None:
        """See `Optimizer`; at most N = `samples` candidates are whole."""
        count = self.particles(samples, problem.segments)
        particles = problem.begin(count)
        tempered = torch.zeros_like(particles.returns).double()  # log weights of the last resampling
        for number in range(1, problem.segments + 1):
            particles = particles.extend(noise_each((count, problem.dimension), problem.generators))
            returns = active_returns(particles)
            inverse, logarithms = adapt_temperature(returns, self.effective_sample_size, before=tempered)
            if number == problem.segments:
                problem.consider(particles)
            particles = particles.take(_resample(logarithms, problem.generators))
            for _ in range(self.moves):
                particles, proposed = self._move(particles, inverse)
                if number == problem.segments:
                    problem.consider(proposed)
            tempered = inverse.unsqueeze(-1) * active_returns(particles).nan_to_num(neginf=0.0)

    def _move(self, particles: Candidates, inverse: Tensor) -> tuple[Candidates, Candidates]:
        """One Metropolis step of every particle, and the proposals; `inverse: [B]` temperatures."""
        problem = particles.problem
        length = min(self.block, len(particles.segments))
        shape = (particles.count, length, problem.dimension)
        # The proposal leaves N(0, I) invariant, so the prior cancels and only the returns decide.
        fresh = noise_each(shape, problem.generators)
        noise = math.sqrt(1.0 - self.step**2) * particles.noise[:, :, -length:] + self.step * fresh
        proposed = particles.back(length)
        for segment in noise.unbind(2):
            proposed = proposed.extend(segment)
        gain = inverse.unsqueeze(-1) * (active_returns(proposed) - active_returns(particles))  # NaN: both failed
        chance = uniform_each((particles.count,), problem.generators)
        accepted = chance.log() < gain
        own = torch.arange(particles.count, device=inverse.device)
        numbers = torch.where(accepted, own + particles.count, own.expand_as(accepted))
        return join([particles, proposed]).take(numbers), proposed


def active_returns(candidates: Candidates) -> Tensor:
    """Returns `[B, n]`, -inf for failed candidates if others have not failed, so that copies replace them."""
    finite = torch.isfinite(candidates.returns)
    valid = finite & ~candidates.score_state.failed
    return torch.where(valid | ~valid.any(-1, keepdim=True), candidates.returns, -torch.inf)


def _resample(logarithms: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
    """Ancestors' numbers `[B, n]` by systematic resampling; without finite weights every candidate stays."""
    count = logarithms.shape[-1]
    weights = torch.softmax(logarithms, -1)
    offsets = uniform_each((1,), generators)
    places = (torch.arange(count, device=weights.device) + offsets.double()) / count
    numbers = torch.searchsorted(weights.cumsum(-1), places).clamp(max=count - 1)
    infinite = ~torch.isfinite(weights).all(-1, keepdim=True)
    return torch.where(infinite, torch.arange(count, device=weights.device), numbers)
