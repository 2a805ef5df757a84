"""Random shooting, the paper's optimiser (section 3.2; Algorithm 1, lines 5 to 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from planning.candidates import Candidates, Search
from planning.replacement import draw_parents


@dataclass(frozen=True)
class Shooting:
    """All samples at once from the prior; plans that die on the way become copies of living ones.

    replacement: false leaves the dead as they are.
    """

    iterations: ClassVar[int] = 1
    replacement: bool = True

    def optimise(self, search: Search, samples: int) -> Candidates:
        """N = `samples` plans `[B, N]` of all K segments."""
        candidates = search.begin(samples)
        for left in reversed(range(search.segments)):
            candidates = candidates.extend()
            standing = candidates.standing
            # After the last segment nobody goes on in the place of the dead.
            if self.replacement and left and bool(standing.failed.any()):
                # Section 3.2: plans that failed early are replaced by copies of plans that are still active.
                candidates = candidates.take(draw_parents(standing.failed, standing.active, search.generators))
        return candidates
