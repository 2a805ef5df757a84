"""iCEM, a sample-efficient cross-entropy method (Pinneri et al., CoRL 2020)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from planning import records
from planning.inputs import check_fraction, check_positive, check_weight
from planning.optimizers.cross_entropy import refit
from planning.optimizers.weights import Population, best, samples_of_iteration
from planning.rollouts.candidates import SearchProblem


@dataclass(frozen=True)
class ImprovedCrossEntropy:
    """The cross-entropy method with kept elites and noise that is coloured over a plan's segments.

    From the published method: coloured noise, elites that compete again in the next iteration, and the mean as a
    candidate of the last iteration. Omitted: elites carried over from the last plan.

    iterations: number of iterations, which share the samples equally. elite_fraction: fraction of an iteration's
    candidates for the next fit. momentum: weight of the last mean and scale in the next. replacement: failed candidates
    become copies of active ones, as in shooting. kept_elite_fraction: fraction of the elites that compete again.
    exponent: the noise's power falls as frequency^-exponent; 0 is white, 2 makes neighbouring segments similar.

    Raises ValueError for counts below 1 and numbers outside of their range.
    """

    iterations: int = 4
    elite_fraction: float = 0.1
    momentum: float = 0.1
    kept_elite_fraction: float = 0.3
    exponent: float = 0.5
    replacement: bool = True

    def __post_init__(self) -> None:
        check_positive("iterations", self.iterations)
        check_fraction("elite_fraction", self.elite_fraction, positive=True)
        check_fraction("momentum", self.momentum)
        check_fraction("kept_elite_fraction", self.kept_elite_fraction)
        check_weight("exponent", self.exponent)

    def optimize(self, problem: SearchProblem, samples: int) -> None:
        """See `Optimizer`; the last candidate is the last mean, unless it was replaced."""
        mean = scale = None
        elites: Population | None = None
        for number in range(self.iterations):
            count = samples_of_iteration(samples, self.iterations, number)
            noise = coloured(problem.noise(count), self.exponent)
            if mean is not None and scale is not None:
                noise = mean + scale * noise
                if number == self.iterations - 1:
                    noise[:, -1:] = mean
            candidates = problem.evaluate(noise, replacement=self.replacement)
            wanted = max(1, round(self.elite_fraction * count))
            population = Population(candidates.noise, candidates.returns)
            if elites is not None:  # predictions repeat exactly: elites compete again at no cost
                population = records.join([best(elites, round(self.kept_elite_fraction * wanted)), population])
            elites = best(population, wanted)
            mean, scale = refit(elites, mean, scale, self.momentum)


def coloured(noise: Tensor, exponent: float) -> Tensor:
    """White noise `[B, n, K, D]` made coloured over its K segments, each number still of variance 1.

    Its power falls as frequency^-exponent (Timmer and Koenig 1995); the lowest frequency, which is zero, has the
    power of the next one.
    """
    segments = noise.shape[2]
    if segments == 1 or exponent == 0:
        return noise
    frequencies = torch.fft.rfftfreq(segments, device=noise.device, dtype=noise.dtype)
    frequencies[0] = frequencies[1]
    gain = frequencies.pow(-exponent / 2.0)
    mirrored = torch.full_like(gain, 2.0)  # but for the ends, frequencies stand for two
    mirrored[0] = 1.0
    if segments % 2 == 0:
        mirrored[-1] = 1.0
    gain = gain / ((mirrored * gain.square()).sum() / segments).sqrt()
    spectrum = torch.fft.rfft(noise, dim=2) * gain[:, None]
    return torch.fft.irfft(spectrum, n=segments, dim=2)
