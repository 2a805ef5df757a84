"""Optimizers, which search candidates by their noise and returns only.

Standard normal noise `[B, n, K, D]` determines codes and actions, so every optimizer respects the prior and the bounds.
"""

from __future__ import annotations

from cavin_pyro.models.checks import check_choice
from cavin_pyro.planning.optimizers.base import Optimizer, Shooting, samples_of_iteration
from cavin_pyro.planning.optimizers.cem import CEM, ICEM
from cavin_pyro.planning.optimizers.mppi import MPPI
from cavin_pyro.planning.optimizers.smc import SMC

__all__ = ["CEM", "ICEM", "MPPI", "OPTIMIZERS", "SMC", "Optimizer", "Shooting", "make_optimizer"]

OPTIMIZERS: dict[str, type[Optimizer]] = {"shooting": Shooting, "cem": CEM, "icem": ICEM, "mppi": MPPI, "smc": SMC}


def make_optimizer(optimizer: str | Optimizer, *, samples: int, argument: str = "optimizer") -> Optimizer:
    """The optimizer of that name, with its defaults, or the given one; `argument` is what errors call it.

    Raises ValueError, naming the valid ones, for an unknown name or an object that is no optimizer, and for fewer
    samples than iterations.
    """
    if isinstance(optimizer, str):
        check_choice(argument, optimizer, OPTIMIZERS)
        optimizer = OPTIMIZERS[optimizer]()
    if isinstance(optimizer, type) or not isinstance(optimizer, Optimizer):
        raise ValueError(
            f"{argument} must be one of {', '.join(OPTIMIZERS)}, or an object with a method "
            f"optimize(problem, samples), not {optimizer!r}"
        )
    if isinstance(optimizer, CEM | MPPI):
        samples_of_iteration(samples, optimizer.iterations, 0)
    return optimizer
