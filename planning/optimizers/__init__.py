"""How candidates are searched: optimizers see noise and returns, and nothing of what these mean.

Codes and pushes are searched as standard normal noise `[B, n, K, D]`, so the prior is kept, and bounds are, whatever an
optimizer does.
"""

from planning.optimizers.cross_entropy import CrossEntropy
from planning.optimizers.evolution import Evolution
from planning.optimizers.improved_cross_entropy import ImprovedCrossEntropy
from planning.optimizers.path_integral import PathIntegral
from planning.optimizers.protocol import Optimizer, search
from planning.optimizers.registry import OPTIMIZERS, make_optimizer
from planning.optimizers.sequential_monte_carlo import SequentialMonteCarlo
from planning.optimizers.shooting import Shooting

__all__ = [
    "OPTIMIZERS",
    "CrossEntropy",
    "Evolution",
    "ImprovedCrossEntropy",
    "Optimizer",
    "PathIntegral",
    "SequentialMonteCarlo",
    "Shooting",
    "make_optimizer",
    "search",
]
