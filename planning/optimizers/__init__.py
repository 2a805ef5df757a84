"""Optimizers, which search candidates by their noise and returns only.

Standard normal noise `[B, n, K, D]` determines codes and pushes, so every optimizer respects the prior and the bounds.
"""

from planning.optimizers.cross_entropy import CrossEntropy
from planning.optimizers.evolution import Evolution
from planning.optimizers.improved_cross_entropy import ImprovedCrossEntropy
from planning.optimizers.path_integral import PathIntegral
from planning.optimizers.proposals import LastPlan, NoiseProposal, Value
from planning.optimizers.protocol import Optimizer, search
from planning.optimizers.registry import OPTIMIZERS, make_optimizer
from planning.optimizers.sequential_monte_carlo import SequentialMonteCarlo
from planning.optimizers.shooting import Shooting

__all__ = [
    "OPTIMIZERS",
    "CrossEntropy",
    "Evolution",
    "ImprovedCrossEntropy",
    "LastPlan",
    "NoiseProposal",
    "Optimizer",
    "PathIntegral",
    "SequentialMonteCarlo",
    "Shooting",
    "Value",
    "make_optimizer",
    "search",
]
