"""Optimizers by name, and the checks of a planner's option `optimizer`."""

from __future__ import annotations

import inspect

from planning.inputs import OptimizerError
from planning.optimizers.cross_entropy import CrossEntropy
from planning.optimizers.evolution import Evolution
from planning.optimizers.improved_cross_entropy import ImprovedCrossEntropy
from planning.optimizers.path_integral import PathIntegral
from planning.optimizers.protocol import Optimizer
from planning.optimizers.sequential_monte_carlo import SequentialMonteCarlo
from planning.optimizers.shooting import Shooting
from planning.optimizers.weights import samples_of_iteration

OPTIMIZERS: dict[str, type[Optimizer]] = {
    "shooting": Shooting,
    "cem": CrossEntropy,
    "icem": ImprovedCrossEntropy,
    "mppi": PathIntegral,
    "evolution": Evolution,
    "smc": SequentialMonteCarlo,
}
ITERATIVE = (CrossEntropy, ImprovedCrossEntropy, PathIntegral, Evolution)


def make_optimizer(optimizer: str | Optimizer, *, samples: int, argument: str = "optimizer") -> Optimizer:
    """The optimizer of that name, with its defaults, or the given one; `argument` is what errors call it.

    Raises ValueError, naming the valid ones, for an unknown name or for an object that is no optimizer; for a method
    `optimize` that takes other arguments; and for fewer samples than iterations.
    """
    if isinstance(optimizer, str):
        if optimizer not in OPTIMIZERS:
            raise ValueError(f"unknown {argument} '{optimizer}': choose from {', '.join(OPTIMIZERS)}")
        optimizer = OPTIMIZERS[optimizer]()
    if isinstance(optimizer, type) or not isinstance(optimizer, Optimizer):
        raise ValueError(
            f"{argument} must be one of {', '.join(OPTIMIZERS)}, or an object with a method "
            f"optimize(problem, samples), not {optimizer!r}"
        )
    _check_arguments(optimizer)
    if isinstance(optimizer, ITERATIVE):
        samples_of_iteration(samples, optimizer.iterations, 0)
    return optimizer


def _check_arguments(optimizer: Optimizer) -> None:
    """Raise OptimizerError unless `optimize` takes a problem and a number of samples."""
    taken = inspect.signature(optimizer.optimize)
    try:
        taken.bind("problem", "samples")
    except TypeError as error:
        raise OptimizerError(
            f"optimizer {type(optimizer).__name__}: optimize must take the arguments (problem, samples), not {taken}"
        ) from error
