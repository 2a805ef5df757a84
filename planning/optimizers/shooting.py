"""Random shooting, the paper's optimizer (section 3.2; Algorithm 1, lines 5 to 10)."""

from __future__ import annotations

from dataclasses import dataclass

from planning.rollouts.candidates import SearchProblem


@dataclass(frozen=True)
class Shooting:
    """All samples at once from the prior.

    The warm start takes the last places, so a new candidate wins among equals: under a sparse reward all candidates
    that miss the goal are equal, and the planner would repeat an old one for ever.

    replacement: "episodes which fail early will be replaced by duplicating episodes that are still active" (section
    3.2); false leaves failed candidates as they are.
    """

    replacement: bool = True

    def optimize(self, problem: SearchProblem, samples: int) -> None:
        """See `Optimizer`."""
        if not problem.reparameterized:
            problem.sample(samples, replacement=self.replacement)
            return
        noise = problem.noise(samples)
        if problem.warm_start is not None:
            known = problem.warm_start[:, :samples]
            noise[:, samples - known.shape[1] :] = known
        problem.evaluate(noise, replacement=self.replacement, early_stopping=problem.best_only)
