"""Evolution of whole plans: random ones first, then mutated copies of the best (Perez et al., GECCO 2013)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cavin_pyro.models.checks import check_number
from cavin_pyro.planning import records
from cavin_pyro.planning.optimizers.base import Population, best, samples_of_iteration
from cavin_pyro.planning.rollout import SearchProblem
from cavin_pyro.planning.sampling import noise_each, uniform_each


@dataclass(frozen=True)
class Evolution:
    """Parents are the best candidates so far; offspring lose some of a parent's segments and mutate others.

    Under a sparse reward a random plan that reaches the goal has many superfluous segments. Fresh segments at the end
    replace the deleted ones, so offspring are as long as their parents.

    generations: number after the initial one, which is sampled from the prior. initial_fraction: fraction of the
    samples for the initial generation. parents: number of parents, at most. deletion_rate: segments that an offspring
    loses, on average. mutation_rate: segments of an offspring that mutate, on average. step: size of a mutation, in
    (0, 1], which leaves the prior invariant; 1 samples the segment anew. Failed candidates of the initial generation
    become copies of active ones, as in shooting.

    Raises ValueError for counts below 1 and numbers outside of their range.
    """

    generations: int = 4
    initial_fraction: float = 0.5
    parents: int = 16
    deletion_rate: float = 2.0
    mutation_rate: float = 1.0
    step: float = 0.5

    def __post_init__(self) -> None:
        check_number("generations", self.generations, 1, whole=True)
        check_number("initial_fraction", self.initial_fraction, high=1, positive=True)
        check_number("parents", self.parents, 1, whole=True)
        check_number("deletion_rate", self.deletion_rate)
        check_number("mutation_rate", self.mutation_rate)
        check_number("step", self.step, high=1, positive=True)

    @property
    def iterations(self) -> int:
        """Number of generations, each of which needs at least one sample."""
        return 1 + self.generations

    def optimize(self, problem: SearchProblem, samples: int) -> None:
        initial = min(max(1, round(self.initial_fraction * samples)), samples - self.generations)
        candidates = problem.evaluate(problem.noise(initial), replacement=True)
        population = Population(candidates.noise, candidates.returns)
        for number in range(self.generations):
            population = best(population, self.parents)
            count = samples_of_iteration(samples - initial, self.generations, number)
            noise = self._offspring(problem, population.noise, count)
            population = records.join([population, Population(noise, problem.evaluate(noise).returns)])

    def _offspring(self, problem: SearchProblem, parents: Tensor, count: int) -> Tensor:
        """`parents: [B, p, K, D]` -> `[B, n, K, D]`, each of one uniformly sampled parent."""
        segments = problem.segments
        sources = problem.generators, problem.device
        whose, how_many, which, changed = uniform_each((4, count, segments), *sources).unbind(1)
        fresh, last = noise_each((2, count, segments, problem.dimension), *sources).unbind(1)
        environments = torch.arange(len(parents), device=parents.device).unsqueeze(-1)
        child = parents[environments, (whose[..., 0] * parents.shape[1]).long()]
        # Some offspring lose no segment, others many.
        deleted = which < 2 * self.deletion_rate / segments * how_many[..., :1]
        order = deleted.int().argsort(dim=-1, stable=True)  # first the segments that stay, in their order
        child = child.gather(2, order.unsqueeze(-1).expand_as(child))
        child = torch.where(deleted.gather(2, order).unsqueeze(-1), last, child)
        mutated = math.sqrt(1.0 - self.step**2) * child + self.step * fresh
        return torch.where((changed < self.mutation_rate / segments).unsqueeze(-1), mutated, child)
