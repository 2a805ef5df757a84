"""The interface of optimizers: one method."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from planning.inputs import OptimizerError
from planning.rollouts.candidates import Candidates, SearchProblem


@runtime_checkable
class Optimizer(Protocol):
    """Searches candidates; docs/how-to/your-own-optimizer.md shows an example of 30 lines."""

    def optimize(self, problem: SearchProblem, samples: int) -> None:
        """Search for candidates of high return, with the budget of N = `samples` whole candidates.

        `problem(noise)` takes candidates, standard normal noise `[B, n, K, D]`, and returns their returns `[B, n]`;
        -inf means that a prediction was not finite. `problem.noise(n)` samples the prior, `problem.generators` are the
        only randomness to use, and `problem.warm_start` is None or noise `[B, h, K, D]` from the last plan. The
        planner chooses the best of all candidates that were evaluated, so this method returns nothing.
        """


def search(optimizer: Optimizer, problem: SearchProblem, samples: int) -> Candidates:
    """All whole candidates `[B, n]` that the optimizer has evaluated.

    Raises OptimizerError, naming the optimizer's class, for candidates of a wrong shape and if it has evaluated none.
    """
    try:
        optimizer.optimize(problem, samples)
        return problem.pop_candidates()
    except OptimizerError as error:
        raise OptimizerError(f"optimizer {type(optimizer).__name__}: {error}") from error
