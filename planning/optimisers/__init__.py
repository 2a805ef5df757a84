"""How is searched: optimisers that see candidates and their returns, and nothing of what these mean.

Each is given a `planning.candidates.Search` and a number of samples and hands back all whole plans that it has
considered. Codes and pushes are searched as standard normal noise `[B, n, K, D]`, so that a prior is kept, and bounds
are, whatever an optimiser does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Protocol

from planning.candidates import Candidates, Search
from planning.optimisers.cross_entropy import CrossEntropy
from planning.optimisers.evolution import Evolution
from planning.optimisers.improved_cross_entropy import ImprovedCrossEntropy
from planning.optimisers.path_integral import PathIntegral
from planning.optimisers.sequential_monte_carlo import SequentialMonteCarlo
from planning.optimisers.shooting import Shooting
from planning.optimisers.weights import share


class Optimiser(Protocol):
    """Anything that searches."""

    @property
    def iterations(self) -> int:
        """How many times at least one sample is needed."""

    def optimise(self, search: Search, samples: int) -> Candidates:
        """At most N = `samples` whole plans `[B, n]`, or the work of so many."""


OPTIMISERS: dict[str, type] = {
    "shooting": Shooting,
    "cem": CrossEntropy,
    "icem": ImprovedCrossEntropy,
    "mppi": PathIntegral,
    "evolution": Evolution,
    "smc": SequentialMonteCarlo,
}


def make_optimiser(name: str, options: Mapping[str, Any] | None = None, *, samples: int) -> Optimiser:
    """The optimiser of that name (the word `planner.optimizer`), with options of its own.

    Raises ValueError, naming the valid ones, for an unknown name or option, and for a value out of its range or
    too few samples.
    """
    if name not in OPTIMISERS:
        raise ValueError(f"unknown optimizer '{name}': choose from {', '.join(OPTIMISERS)}")
    known = [field.name for field in fields(OPTIMISERS[name])]
    if not isinstance(options or {}, Mapping):
        raise ValueError(f"optimizer_options must be a section like {{{known[0]}: value}}, not {options}")
    for option in options or {}:
        if option not in known:
            raise ValueError(f"unknown option '{option}' of optimizer {name}: valid are {', '.join(known)}")
    try:
        optimiser: Optimiser = OPTIMISERS[name](**(options or {}))
    except TypeError as error:
        raise ValueError(f"optimizer {name}: an option is of the wrong kind ({error})") from error
    share(samples, optimiser.iterations, 0)
    return optimiser


__all__ = [
    "OPTIMISERS",
    "CrossEntropy",
    "Evolution",
    "ImprovedCrossEntropy",
    "Optimiser",
    "PathIntegral",
    "SequentialMonteCarlo",
    "Shooting",
    "make_optimiser",
]
