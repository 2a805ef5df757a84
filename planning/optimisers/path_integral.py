"""Model predictive path integral control (Williams et al., ICRA 2017), in noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from planning.candidates import Candidates, Search, join
from planning.inputs import check_fraction, check_positive
from planning.optimisers.weights import adapt_temperature, share


@dataclass(frozen=True)
class PathIntegral:
    """Draws around the mean of the last draws, weighted by exp(return / temperature); beginning with the prior.

    iterations: the samples are shared among them. temperature: in units of the return; None for the one at
    which the weights' effective size is `effective` of the candidates, whatever the returns' range. shrink: factor
    from one iteration's scale to the next's. replacement: as `CrossEntropy`.

    Raises ValueError for counts below 1 and numbers outside of their range.
    """

    iterations: int = 4
    temperature: float | None = None
    effective: float = 0.05
    shrink: float = 0.6
    replacement: bool = True

    def __post_init__(self) -> None:
        check_positive("iterations", self.iterations)
        check_fraction("effective", self.effective, positive=True)
        check_fraction("shrink", self.shrink, positive=True)
        if self.temperature is not None and not 0 < self.temperature < math.inf:
            raise ValueError(f"temperature must be a positive number or null, not {self.temperature}")

    def optimise(self, search: Search, samples: int) -> Candidates:
        """All N = `samples` plans `[B, N]` that were considered; the last one is the last mean, unless that died."""
        mean, considered = None, []
        for number in range(self.iterations):
            noise = search.noise(share(samples, self.iterations, number))
            if mean is not None:
                noise = mean + self.shrink**number * noise
                if number == self.iterations - 1:
                    noise[:, -1:] = mean
            candidates = search.evaluate(noise, replacement=self.replacement)
            considered.append(candidates)
            if self.temperature is None:
                _, logarithms = adapt_temperature(candidates.returns, self.effective)
            else:
                logarithms = candidates.returns / self.temperature
            # Where no candidate counts the mean stays: all weights are zero.
            weights = torch.softmax(logarithms, -1).nan_to_num(0.0).to(noise.dtype)[..., None, None]
            old = torch.zeros_like(noise[:, :1]) if mean is None else mean
            found = (weights > 0).any(1, keepdim=True)
            mean = torch.where(found, (weights * candidates.noise).sum(1, keepdim=True), old)
        return join(considered)
