"""Random shooting, the paper's optimiser (section 3.2; Algorithm 1, lines 5 to 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from planning.candidates import Candidates, Search


@dataclass(frozen=True)
class Shooting:
    """All samples at once from the prior; plans that die on the way become copies of living ones.

    What is left of the last plan, where the planner remembers it, takes the last places, so that of equals a new plan
    wins: under a sparse reward all plans that do not reach the goal are equal, and an old one would be made for ever.

    replacement: section 3.2, "episodes which fail early will be replaced"; false leaves the dead as they are.
    """

    iterations: ClassVar[int] = 1
    replacement: bool = True

    def optimise(self, search: Search, samples: int) -> Candidates:
        """N = `samples` plans `[B, N]` of all K segments."""
        if not search.from_noise:
            return search.draw(samples, replacement=self.replacement)
        noise = search.noise(samples)
        if search.hints is not None:
            known = search.hints[:, :samples]
            noise[:, samples - known.shape[1] :] = known
        return search.evaluate(noise, replacement=self.replacement, for_best=search.best_only)
