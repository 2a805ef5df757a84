"""The cross-entropy method (Rubinstein and Kroese 2004), in the noise of codes or pushes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from planning.inputs import check_fraction, check_positive
from planning.optimizers.weights import Population, best, samples_of_iteration
from planning.rollouts.candidates import SearchProblem

MINIMUM_SCALE = 1e-3  # so that a search never collapses onto a point


@dataclass(frozen=True)
class CrossEntropy:
    """Samples from a Gaussian fitted to the elites of the last iteration; the first iteration samples the prior.

    iterations: number of iterations, which share the samples equally. elite_fraction: fraction of an iteration's
    candidates for the next fit. momentum: weight of the last mean and scale in the next. replacement: failed candidates
    become copies of active ones, as in shooting.

    Raises ValueError for counts below 1 and fractions outside of their range.
    """

    iterations: int = 4
    elite_fraction: float = 0.1
    momentum: float = 0.1
    replacement: bool = True

    def __post_init__(self) -> None:
        check_positive("iterations", self.iterations)
        check_fraction("elite_fraction", self.elite_fraction, positive=True)
        check_fraction("momentum", self.momentum)

    def optimize(self, problem: SearchProblem, samples: int) -> None:
        """See `Optimizer`; the last candidate is the last mean, unless it was replaced."""
        mean = scale = None
        for number in range(self.iterations):
            count = samples_of_iteration(samples, self.iterations, number)
            noise = problem.noise(count)
            if mean is not None and scale is not None:
                noise = mean + scale * noise
                if number == self.iterations - 1:
                    noise[:, -1:] = mean
            candidates = problem.evaluate(noise, replacement=self.replacement)
            elites = best(Population(candidates.noise, candidates.returns), max(1, round(self.elite_fraction * count)))
            mean, scale = refit(elites, mean, scale, self.momentum)


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
