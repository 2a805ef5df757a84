"""Evolution of whole plans: random ones first, then changed copies of the best (Perez et al., GECCO 2013)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from planning import fields
from planning.candidates import Candidates, Search, join
from planning.inputs import check_fraction, check_positive, check_weight
from planning.optimisers.weights import Tried, best, share
from planning.sampling import noise_each, uniform_each


@dataclass(frozen=True)
class Evolution:
    """Parents are the best so far; children leave some of a parent's segments out, and alter others.

    Under a sparse reward a random chain that reaches the goal does much besides that the goal does not need. What
    is left out makes room for fresh segments at the end, so that children are as long as their parents.

    generations: after the first, which is drawn from the prior. first: fraction of the samples that the first one
    takes. parents: how many, at most. omitted, altered: segments, on average, of a child. step: of an alteration, in
    (0, 1], which leaves the prior invariant; 1 draws the segment anew. replacement: as in shooting, in the first
    generation. memory: fraction of the first generation that is what is left of the last plan, and its children.

    Raises ValueError for counts below 1 and numbers outside of their range.
    """

    generations: int = 4
    first: float = 0.5
    parents: int = 16
    omitted: float = 2.0
    altered: float = 1.0
    step: float = 0.5
    replacement: bool = True
    memory: float = 0.2

    def __post_init__(self) -> None:
        check_positive("generations", self.generations)
        check_fraction("first", self.first, positive=True)
        check_positive("parents", self.parents)
        for name in ("omitted", "altered"):
            check_weight(name, getattr(self, name))
        check_fraction("step", self.step, positive=True)
        check_fraction("memory", self.memory)

    @property
    def iterations(self) -> int:
        """How many times at least one sample is needed."""
        return 1 + self.generations

    def optimise(self, search: Search, samples: int) -> Candidates:
        """All N = `samples` plans `[B, N]` that were considered."""
        begin = min(max(1, round(self.first * samples)), samples - self.generations)
        noise = search.noise(begin)
        heirs = min(begin, math.ceil(self.memory * begin))
        if heirs and search.hints is not None:
            # In the last places: of equals, such as all that do not reach the goal, a new plan wins.
            known = torch.cat([search.hints, self._children(search, search.hints, heirs)], 1)
            noise[:, begin - heirs :] = known[:, :heirs]
        considered = [search.evaluate(noise, replacement=self.replacement)]
        tried = Tried(considered[0].noise, considered[0].returns)
        for number in range(self.generations):
            tried = best(tried, self.parents)
            noise = self._children(search, tried.noise, share(samples - begin, self.generations, number))
            considered.append(search.evaluate(noise))
            tried = fields.join([tried, Tried(noise, considered[-1].returns)])
        return join(considered)

    def _children(self, search: Search, parents: Tensor, count: int) -> Tensor:
        """`parents: [B, p, K, D]` -> `[B, n, K, D]`, each of one parent drawn uniformly."""
        segments = search.segments
        whose, how_many, which, altered = uniform_each((4, count, segments), search.generators).unbind(1)
        fresh, last = noise_each((2, count, segments, search.dimension), search.generators).unbind(1)
        environments = torch.arange(len(parents), device=parents.device).unsqueeze(-1)
        child = parents[environments, (whose[..., 0] * parents.shape[1]).long()]
        # In some children nothing is left out, in others much.
        omitted = which < 2 * self.omitted / segments * how_many[..., :1]
        order = omitted.int().argsort(dim=-1, stable=True)  # those that stay, as they were, then the others
        child = child.gather(2, order.unsqueeze(-1).expand_as(child))
        child = torch.where(omitted.gather(2, order).unsqueeze(-1), last, child)
        moved = math.sqrt(1.0 - self.step**2) * child + self.step * fresh
        return torch.where((altered < self.altered / segments).unsqueeze(-1), moved, child)
