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

from cavin_pyro.models.checks import check_number
from cavin_pyro.planning.optimizers.weights import adapt_temperature, effective_sample_size, log_mean
from cavin_pyro.planning.protocol import Evidence
from cavin_pyro.planning.rollout import Candidates, SearchProblem, join
from cavin_pyro.planning.sampling import noise_each, uniform_each


@dataclass(frozen=True)
class SMC:
    """Extends, weights, resamples and moves particles, a segment at a time.

    After segment k of K the particles target p(codes) exp(return so far / temperature_k); docs/explanation/planning.md
    says more. The estimate of Z, the prior's expectation of exp(return / temperature), is in the plan's `evidence`. It
    is unbiased with a `temperature`; without one, failed particles count as impossible while others have not failed.

    effective_sample_size: without a `temperature`, the one after a segment is the lowest at which the weights'
    effective sample size is this fraction of the particles that have not failed. moves: number for every particle
    after every segment. block: last segments that a move changes. step: size of a move, in (0, 1]; 1 samples
    independently of the current value. temperature: temperature of the target, in units of the return; None adapts it.

    Extending n particles over K segments and moving their last ones costs as much as N samples of shooting.

    Raises ValueError for a block below 1, fewer than 0 moves, a temperature that is not positive, and fractions outside
    of their range.
    """

    effective_sample_size: float = 0.3
    moves: int = 1
    block: int = 2
    step: float = 0.4
    temperature: float | None = None

    def __post_init__(self) -> None:
        check_number("effective_sample_size", self.effective_sample_size, high=1, positive=True)
        check_number("moves", self.moves, whole=True)
        check_number("block", self.block, 1, whole=True)
        check_number("step", self.step, high=1, positive=True)
        check_number("temperature", 1 if self.temperature is None else self.temperature, positive=True)

    def particles(self, samples: int, segments: int) -> int:
        """n, for which extending and moving costs at most N = `samples` whole plans; at least 1."""
        moved = sum(min(number, self.block) for number in range(1, segments + 1))
        return max(1, samples * segments // (segments + self.moves * moved))

    def optimize(self, problem: SearchProblem, samples: int) -> None:
        """See `Optimizer`; at most N = `samples` candidates are whole."""
        count = self.particles(samples, problem.segments)
        particles = problem.begin(count)
        tempered = torch.zeros_like(particles.returns).double()  # log density over the prior's, after moves
        evidence, sizes = torch.zeros_like(tempered[:, 0]), []
        for number in range(1, problem.segments + 1):
            noise = noise_each((count, problem.dimension), problem.generators, problem.device)
            particles = particles.extend(noise)
            scores = self._scores(particles)
            inverse, relative = self._tempered(scores, tempered)
            logarithms = inverse.unsqueeze(-1) * scores.double() - tempered
            evidence = evidence + log_mean(logarithms)
            sizes.append(effective_sample_size(logarithms))
            if number == problem.segments:
                problem.add_candidates(particles)
            particles = particles.take(_resample(relative, problem.generators))
            for _ in range(self.moves):
                particles, proposed = self._move(particles, inverse)
                if number == problem.segments:
                    problem.add_candidates(proposed)
            tempered = inverse.unsqueeze(-1) * self._scores(particles).nan_to_num(neginf=0.0)
        possible = torch.full_like(evidence, count, dtype=torch.int64)
        problem.evidence.append(Evidence(evidence, 1.0 / inverse, torch.stack(sizes, -1), possible))

    def _tempered(self, scores: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse temperatures `[B]` after a segment, and log weights `[B, n]` up to a constant."""
        if self.temperature is None:
            return adapt_temperature(scores, self.effective_sample_size, before=before)
        inverse = 1.0 / self.temperature
        return torch.full_like(before[:, 0], inverse), inverse * scores.double() - before

    def _move(self, particles: Candidates, inverse: Tensor) -> tuple[Candidates, Candidates]:
        """One Metropolis step of every particle, and the proposals; `inverse: [B]` temperatures."""
        problem = particles.problem
        length = min(self.block, len(particles.segments))
        shape = (particles.count, length, problem.dimension)
        # The proposal leaves N(0, I) invariant, so the prior cancels and only the returns decide.
        fresh = noise_each(shape, problem.generators, problem.device)
        noise = math.sqrt(1.0 - self.step**2) * particles.noise[:, :, -length:] + self.step * fresh
        proposed = particles.back(length)
        for segment in noise.unbind(2):
            proposed = proposed.extend(segment)
        gain = inverse.unsqueeze(-1) * (self._scores(proposed) - self._scores(particles))  # NaN: both failed
        chance = uniform_each((particles.count,), problem.generators, problem.device)
        accepted = chance.log() < gain
        own = torch.arange(particles.count, device=inverse.device)
        indices = torch.where(accepted, own + particles.count, own.expand_as(accepted))
        return join([particles, proposed]).take(indices), proposed

    def _scores(self, candidates: Candidates) -> Tensor:
        """Returns so far `[B, n]`; -inf for candidates of weight zero."""
        return active_returns(candidates) if self.temperature is None else candidates.returns


def active_returns(candidates: Candidates) -> Tensor:
    """Returns `[B, n]`, -inf for failed candidates if others have not failed, so that copies replace them."""
    finite = torch.isfinite(candidates.returns)
    valid = finite & ~candidates.score_state.failed
    return torch.where(valid | ~valid.any(-1, keepdim=True), candidates.returns, -torch.inf)


def _resample(logarithms: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
    """Ancestors' indices `[B, n]` int64 by systematic resampling, where a weight is not zero."""
    count = logarithms.shape[-1]
    weights = torch.softmax(logarithms, -1)
    offsets = uniform_each((1,), generators, weights.device)
    places = (torch.arange(count, device=weights.device) + offsets.double()) / count
    indices = torch.searchsorted(weights.cumsum(-1), places).clamp(max=count - 1)
    stay = ~torch.isfinite(weights).all(-1, keepdim=True)
    return torch.where(stay, torch.arange(count, device=weights.device), indices)
