"""The cross-entropy method (Rubinstein and Kroese 2004), in the noise that codes or pushes are made of."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from planning.candidates import Candidates, Search, join
from planning.inputs import check_fraction, check_positive
from planning.optimisers.weights import Tried, best, share

MINIMUM_SCALE = 1e-3  # so that a search never collapses onto a point


@dataclass(frozen=True)
class CrossEntropy:
    """Draws around the best of the last draws, beginning with the prior.

    iterations: the samples are shared among them. elites: fraction of an iteration's candidates that the next
    one is drawn around. inertia: weight of the last mean and scale in the next. replacement: whether plans that
    die become copies of living ones, as in shooting.

    Raises ValueError for counts below 1 and fractions outside of their range.
    """

    iterations: int = 4
    elites: float = 0.1
    inertia: float = 0.1
    replacement: bool = True

    def __post_init__(self) -> None:
        check_positive("iterations", self.iterations)
        check_fraction("elites", self.elites, positive=True)
        check_fraction("inertia", self.inertia)

    def optimise(self, search: Search, samples: int) -> Candidates:
        """All N = `samples` plans `[B, N]` that were considered; the last one is the last mean, unless that died."""
        mean = scale = None
        considered = []
        for number in range(self.iterations):
            count = share(samples, self.iterations, number)
            noise = search.noise(count)
            if mean is not None and scale is not None:
                noise = mean + scale * noise
                if number == self.iterations - 1:
                    noise[:, -1:] = mean
            candidates = search.evaluate(noise, replacement=self.replacement)
            considered.append(candidates)
            elites = best(Tried(candidates.noise, candidates.returns), max(1, round(self.elites * count)))
            mean, scale = refit(elites, mean, scale, self.inertia)
        return join(considered)


def refit(elites: Tried, mean: Tensor | None, scale: Tensor | None, inertia: float) -> tuple[Tensor, Tensor]:
    """Mean and scale `[B, 1, K, D]` of the elites `[B, n]`, with some of the last ones' (zero and one at first).

    Elites whose return is not finite do not count.
    """
    counts = torch.isfinite(elites.returns)[..., None, None]
    noise = torch.where(counts, elites.noise, 0.0)
    number = counts.sum(1, keepdim=True).clamp(min=1)
    new_mean = noise.sum(1, keepdim=True) / number
    variance = torch.where(counts, (noise - new_mean).square(), 0.0).sum(1, keepdim=True) / number
    new_scale = variance.sqrt()
    old_mean = torch.zeros_like(new_mean) if mean is None else mean
    old_scale = torch.ones_like(new_scale) if scale is None else scale
    mean = inertia * old_mean + (1.0 - inertia) * new_mean
    return mean, (inertia * old_scale + (1.0 - inertia) * new_scale).clamp(min=MINIMUM_SCALE)
