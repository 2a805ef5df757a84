"""The interface of optimizers, one method; random shooting, the simplest; and what several of the others share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from torch import Tensor

from cavin_pyro.planning import records
from cavin_pyro.planning.rollout import SearchProblem


@runtime_checkable
class Optimizer(Protocol):
    """Searches candidates; docs/how-to/your-own-optimizer.md shows an example of 30 lines."""

    def optimize(self, problem: SearchProblem, samples: int) -> None:
        """Search for candidates of high return, with the budget of N = `samples` whole candidates.

        `problem(noise)` takes candidates, standard normal noise `[B, n, K, D]`, and returns their returns `[B, n]`;
        -inf means that a prediction was not finite. `problem.noise(n)` samples the prior, `problem.generators` are the
        only randomness to use. The planner chooses the best of all candidates that were evaluated, so this method
        returns nothing.
        """


@dataclass(frozen=True)
class Shooting:
    """Random shooting, the paper's optimizer (section 3.2; Algorithm 1, lines 5 to 10): all samples from the prior.

    replacement: "episodes which fail early will be replaced by duplicating episodes that are still active" (section
    3.2); false leaves failed candidates as they are.
    """

    replacement: bool = True

    def optimize(self, problem: SearchProblem, samples: int) -> None:
        if not problem.reparameterized:
            problem.sample(samples, replacement=self.replacement)
            return
        noise = problem.noise(samples)
        problem.evaluate(noise, replacement=self.replacement, early_stopping=problem.early_stopping)


class Population(NamedTuple):
    """Candidates and their returns."""

    noise: Tensor  # [B, n, K, D]
    returns: Tensor  # [B, n]


def best(population: Population, count: int) -> Population:
    """The `count` with the highest returns, best first: `[B, n] -> [B, count]`."""
    return records.take(population, population.returns.topk(min(count, population.returns.shape[-1]), -1).indices)


def samples_of_iteration(samples: int, iterations: int, number: int) -> int:
    """The number of the N = `samples` for iteration `number` of `iterations`; the first iterations take the remainder.

    Raises ValueError if there are fewer samples than iterations.
    """
    if samples < iterations:
        raise ValueError(f"{iterations} iterations need at least as many samples (see motion_share), not {samples}")
    return samples // iterations + (number < samples % iterations)
