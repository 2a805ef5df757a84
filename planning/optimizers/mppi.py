"""Model predictive path integral control (Williams et al., ICRA 2017), in noise."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from cavin_pyro.models.checks import check_number
from cavin_pyro.planning.optimizers.base import samples_of_iteration
from cavin_pyro.planning.optimizers.weights import adapt_temperature
from cavin_pyro.planning.rollout import SearchProblem


@dataclass(frozen=True)
class MPPI:
    """Samples around the last mean, weighted by exp(return / temperature); the first iteration samples the prior.

    iterations: number of iterations, which share the samples equally. temperature: temperature of the weights, in units
    of the return; None adapts it to `effective_sample_size`. effective_sample_size: effective sample size of the
    weights with an adapted temperature, as a fraction of the candidates. shrink: factor from one iteration's scale to
    the next's. Failed candidates become copies of active ones, as in shooting.

    Raises ValueError for counts below 1 and numbers outside of their range.
    """

    iterations: int = 4
    temperature: float | None = None
    effective_sample_size: float = 0.05
    shrink: float = 0.6

    def __post_init__(self) -> None:
        check_number("iterations", self.iterations, 1, whole=True)
        check_number("effective_sample_size", self.effective_sample_size, high=1, positive=True)
        check_number("shrink", self.shrink, high=1, positive=True)
        check_number("temperature", 1 if self.temperature is None else self.temperature, positive=True)

    def optimize(self, problem: SearchProblem, samples: int) -> None:
        """See `Optimizer`; the last candidate is the last mean, unless it was replaced."""
        mean = None
        for number in range(self.iterations):
            noise = problem.noise(samples_of_iteration(samples, self.iterations, number))
            if mean is not None:
                noise = mean + self.shrink**number * noise
                if number == self.iterations - 1:
                    noise[:, -1:] = mean
            candidates = problem.evaluate(noise, replacement=True)
            if self.temperature is None:
                _, logarithms = adapt_temperature(candidates.returns, self.effective_sample_size)
            else:
                logarithms = candidates.returns / self.temperature
            # Without a finite candidate all weights are zero, and the mean stays.
            weights = torch.softmax(logarithms, -1).nan_to_num(0.0).to(noise.dtype)[..., None, None]
            old = torch.zeros_like(noise[:, :1]) if mean is None else mean
            found = (weights > 0).any(1, keepdim=True)
            mean = torch.where(found, (weights * candidates.noise).sum(1, keepdim=True), old)
