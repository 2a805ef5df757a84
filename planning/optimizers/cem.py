"""The cross-entropy method and iCEM, in the noise of codes or actions."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cavin_pyro.models.checks import check_number
from cavin_pyro.planning import records
from cavin_pyro.planning.optimizers.base import Population, best, samples_of_iteration
from cavin_pyro.planning.rollout import SearchProblem

MINIMUM_SCALE = 1e-3  # so that a search never collapses onto a point


@dataclass(frozen=True)
class CEM:
    """Samples from a Gaussian fitted to the elites of the last iteration; the first iteration samples the prior.

    The cross-entropy method (Rubinstein and Kroese 2004).

    iterations: number of iterations, which share the samples equally. elite_fraction: fraction of an iteration's
    candidates for the next fit. momentum: weight of the last mean and scale in the next. Failed candidates become
    copies of active ones, as in shooting.

    Raises ValueError for counts below 1 and fractions outside of their range.
    """

    iterations: int = 4
    elite_fraction: float = 0.1
    momentum: float = 0.1

    def __post_init__(self) -> None:
        check_number("iterations", self.iterations, 1, whole=True)
        check_number("elite_fraction", self.elite_fraction, high=1, positive=True)
        check_number("momentum", self.momentum, high=1)

    def optimize(self, problem: SearchProblem, samples: int) -> None:
        """See `Optimizer`; the last candidate is the last mean, unless it was replaced."""
        mean = scale = elites = None
        for number in range(self.iterations):
            count = samples_of_iteration(samples, self.iterations, number)
            noise = self.colour(problem.noise(count))
            if mean is not None and scale is not None:
                noise = mean + scale * noise
                if number == self.iterations - 1:
                    noise[:, -1:] = mean
            candidates = problem.evaluate(noise, replacement=True)
            wanted = max(1, round(self.elite_fraction * count))
            population = self.competing(Population(candidates.noise, candidates.returns), elites, wanted)
            elites = best(population, wanted)
            mean, scale = refit(elites, mean, scale, self.momentum)

    def colour(self, noise: Tensor) -> Tensor:
        """The noise `[B, n, K, D]` of new candidates, from white noise: unchanged here."""
        return noise

    def competing(self, population: Population, elites: Population | None, wanted: int) -> Population:
        """The candidates of which `wanted` become elites: those of this iteration alone."""
        return population


@dataclass(frozen=True)
class ICEM(CEM):
    """The cross-entropy method with kept elites and noise that is coloured over a plan's segments.

    iCEM (Pinneri et al., CoRL 2020). From the published method: coloured noise, elites that compete again in the next
    iteration, and the mean as a candidate of the last iteration. Omitted: elites carried over from the last plan.

    kept_elite_fraction: fraction of the elites that compete again. exponent: the noise's power falls as
    frequency^-exponent; 0 is white, 2 makes neighbouring segments similar. For the rest see `CEM`.
    """

    kept_elite_fraction: float = 0.3
    exponent: float = 0.5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("kept_elite_fraction", self.kept_elite_fraction, high=1)
        check_number("exponent", self.exponent, high=10)

    def colour(self, noise: Tensor) -> Tensor:
        """Noise `[B, n, K, D]` that is coloured over the segments."""
        return coloured(noise, self.exponent)

    def competing(self, population: Population, elites: Population | None, wanted: int) -> Population:
        """The candidates of this iteration, and some of the last elites."""
        if elites is None:
            return population
        # Predictions repeat exactly: elites compete again at no cost.
        return records.join([best(elites, round(self.kept_elite_fraction * wanted)), population])


def refit(elites: Population, mean: Tensor | None, scale: Tensor | None, momentum: float) -> tuple[Tensor, Tensor]:
    """Mean and scale `[B, 1, K, D]` of the elites `[B, n]`, mixed with the last ones (zero and one at first).

    Elites without a finite return do not count.
    """
    counts = torch.isfinite(elites.returns)[..., None, None]
    noise = torch.where(counts, elites.noise, 0.0)
    number = counts.sum(1, keepdim=True).clamp(min=1)
    new_mean = noise.sum(1, keepdim=True) / number
    variance = torch.where(counts, (noise - new_mean).square(), 0.0).sum(1, keepdim=True) / number
    new_scale = variance.sqrt()
    old_mean = torch.zeros_like(new_mean) if mean is None else mean
    old_scale = torch.ones_like(new_scale) if scale is None else scale
    mean = momentum * old_mean + (1.0 - momentum) * new_mean
    return mean, (momentum * old_scale + (1.0 - momentum) * new_scale).clamp(min=MINIMUM_SCALE)


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
