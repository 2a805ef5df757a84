"""The interface of priors."""

from __future__ import annotations

from typing import Protocol

from pyro.distributions import TorchDistribution
from torch import Tensor

from models.state import State


class Prior(Protocol):
    """p(c | s) or p(z | s, c). A structural type: derive a prior from `torch.nn.Module`, not from this.

    `build_model` constructs a prior for each code of a model, with the keywords

    `dimension`            of the code
    `feature_dimension`    F of the states
    `effect_dimension`     C for p(z | s, c), None for p(c | s)
    """

    def __call__(self, state: State, effect_code: Tensor | None = None) -> TorchDistribution:
        """`state: [...]`, `effect_code: [..., C]` for p(z | s, c) -> batch `[...]`, event `[dimension]`.

        Leading dimensions broadcast. A planner's warm start and its optimizers other than `shooting` need a Gaussian,
        or a distribution with a method `reparameterize(noise)`.
        """
