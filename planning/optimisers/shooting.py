"""Random shooting, the paper's optimiser (section 3.2; Algorithm 1, lines 5 to 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from planning.candidates import Candidates, Search


@dataclass(frozen=True)
class Shooting:
    """All samples at once from the prior; plans that die on the way become copies of living ones.

    replacement: section 3.2, "episodes which fail early will be replaced"; false leaves the dead as they are.
    """

    iterations: ClassVar[int] = 1
    replacement: bool = True

    def optimise(self, search: Search, samples: int) -> Candidates:
        """N = `samples` plans `[B, N]` of all K segments."""
        return search.draw(samples, replacement=self.replacement)
