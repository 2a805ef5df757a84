"""Planning as inference by sequential Monte Carlo, segment by segment.

Plans are drawn from p(plan) exp(return / temperature): the learned prior, weighted by how well plans do (Levine
2018; Piche et al., ICLR 2019). Resampling and moves as in Del Moral, Doucet and Jasra (2006), moves that leave the
prior invariant as in Cotter et al. (2013), "preconditioned Crank-Nicolson".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from planning.candidates import Candidates, Search, join
from planning.inputs import check_fraction, check_positive
from planning.optimisers.weights import adapt_temperature
from planning.sampling import noise_each, uniform_each


@dataclass(frozen=True)
class SequentialMonteCarlo:
    """Particles that are prolonged, weighted, resampled and moved, a segment at a time.

    effective: the temperature after a segment is the lowest at which the weights' effective size is this fraction
    of the particles that live. moves: of every particle after every segment. block: last segments that a
    move changes. step: of a move, in (0, 1]; 1 forgets where it begins.

    Prolonging n particles over K segments and moving their last ones costs as much as N samples of shooting.

    Raises ValueError for a block below 1, fewer than 0 moves and fractions outside of their range.
    """

    iterations: ClassVar[int] = 1
    effective: float = 0.3
    moves: int = 1
    block: int = 2
    step: float = 0.4

    def __post_init__(self) -> None:
        check_fraction("effective", self.effective, positive=True)
        if self.moves < 0:
            raise ValueError(f"moves must be at least 0, not {self.moves}")
        check_positive("block", self.block)
        check_fraction("step", self.step, positive=True)

    def particles(self, samples: int, segments: int) -> int:
        """n, for which prolonging and moving costs at most N = `samples` whole plans; at least 1."""
        moved = sum(min(number, self.block) for number in range(1, segments + 1))
        return max(1, samples * segments // (segments + self.moves * moved))

    def optimise(self, search: Search, samples: int) -> Candidates:
        """All whole plans `[B, .]` that were considered, at most N = `samples` of them."""
        count = self.particles(samples, search.segments)
        particles = search.begin(count)
        tempered = torch.zeros_like(particles.returns).double()  # log weights by which they have been drawn
        considered: list[Candidates] = []
        for number in range(1, search.segments + 1):
            particles = particles.extend(noise_each((count, search.dimension), search.generators))
            returns = living_returns(particles)
            inverse, logarithms = adapt_temperature(returns, self.effective, before=tempered)
            if number == search.segments:
                considered.append(particles)
            particles = particles.take(_resample(logarithms, search.generators))
            for _ in range(self.moves):
                particles, proposed = self._move(particles, inverse)
                if number == search.segments:
                    considered.append(proposed)
            tempered = inverse.unsqueeze(-1) * living_returns(particles).nan_to_num(neginf=0.0)
        return join(considered)

    def _move(self, particles: Candidates, inverse: Tensor) -> tuple[Candidates, Candidates]:
        """One Metropolis step of every particle, and what was proposed; `inverse: [B]` temperatures."""
        search = particles.search
        length = min(self.block, len(particles.kept))
        shape = (particles.count, length, search.dimension)
        # The proposal leaves N(0, I) invariant, so that the prior cancels and returns alone decide.
        fresh = noise_each(shape, search.generators)
        noise = math.sqrt(1.0 - self.step**2) * particles.noise[:, :, -length:] + self.step * fresh
        proposed = particles.back(length)
        for segment in noise.unbind(2):
            proposed = proposed.extend(segment)
        gain = inverse.unsqueeze(-1) * (living_returns(proposed) - living_returns(particles))  # NaN: both dead
        chance = uniform_each((particles.count,), search.generators)
        accepted = chance.log() < gain
        own = torch.arange(particles.count, device=inverse.device)
        numbers = torch.where(accepted, own + particles.count, own.expand_as(accepted))
        return join([particles, proposed]).take(numbers), proposed


def living_returns(candidates: Candidates) -> Tensor:
    """Returns `[B, n]`, -inf for the dead in environments where others are alive: copies take their places."""
    finite = torch.isfinite(candidates.returns)
    living = finite & ~candidates.standing.failed
    return torch.where(living | ~living.any(-1, keepdim=True), candidates.returns, -torch.inf)


def _resample(logarithms: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
    """Numbers `[B, n]` of the plans to go on with, by systematic resampling; without weights everybody stays."""
    count = logarithms.shape[-1]
    weights = torch.softmax(logarithms, -1)
    offsets = uniform_each((1,), generators)
    places = (torch.arange(count, device=weights.device) + offsets.double()) / count
    numbers = torch.searchsorted(weights.cumsum(-1), places).clamp(max=count - 1)
    hopeless = ~torch.isfinite(weights).all(-1, keepdim=True)
    return torch.where(hopeless, torch.arange(count, device=weights.device), numbers)
