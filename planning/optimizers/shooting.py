"""Random shooting, the paper's optimizer (section 3.2; Algorithm 1, lines 5 to 10)."""

from __future__ import annotations

from dataclasses import dataclass

from cavin_pyro.planning.rollout import SearchProblem


@dataclass(frozen=True)
class Shooting:
    """All samples at once from the prior.

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
