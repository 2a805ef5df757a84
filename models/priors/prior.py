"""The interface of priors, and what learned ones read of a scene."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor, nn

from cavin_pyro.models.checks import check_last
from cavin_pyro.models.networks.layers import fully_connected
from cavin_pyro.models.part import Part
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State


@runtime_checkable
class Prior(Protocol):
    """p(c | s) or p(z | s, c). A structural type: derive a prior from `torch.nn.Module`, not from this.

    `build_model` constructs a prior for each code of a model, with the keywords

    `space`                of the world
    `dimension`            of the code
    `feature_dimension`    F of the states
    `effect_dimension`     C for p(z | s, c), None for p(c | s)
    """

    def __call__(self, state: State, effect_code: Tensor | None = None) -> TorchDistribution:
        """`state: [...]`, `effect_code: [..., C]` for p(z | s, c) -> batch `[...]`, event `[dimension]`.

        Leading dimensions broadcast. A planner's optimizers other than `shooting` need a Gaussian,
        or a distribution with a method `reparameterize(noise)`.
        """


class SceneContext(nn.Module):
    """Feature of a state and, optionally, an effect code; cheap enough to compute for every candidate of a planner.

    Per object two FC on (center, feature, effect code); sum over real objects; FC. Invariant to the order of objects
    and to padding.
    """

    def __init__(self, space: Space, *, feature_dimension: int, effect_dimension: int | None, width: int) -> None:
        super().__init__()
        self.space = space
        self.from_object = nn.Linear(space.inputs + feature_dimension, width)
        self.from_code = None if effect_dimension is None else nn.Linear(effect_dimension, width, bias=False)
        self.objects = fully_connected(width, width)
        self.scene = fully_connected(width, width)

    def forward(self, state: State, effect_code: Tensor | None) -> Tensor:
        """`state: [...]`, `effect_code: [..., C]` -> `[..., width]`; leading dimensions broadcast.

        Raises `ValueError` for a state or an effect code of other dimensions.
        """
        return self.parts(state, effect_code)[1]

    def parts(self, state: State, effect_code: Tensor | None) -> tuple[Tensor, Tensor]:
        """Features of each object `[..., M, width]`, zero for padding, and of the scene `[..., width]`."""
        self.space.check(state, self.from_object.in_features - self.space.inputs)
        place = self.space.describe(state, self.space.locate(state))
        hidden = self.from_object(torch.cat((place, state.features), -1))
        if self.from_code is not None:
            check_last("effect_code of this p(z | s, c)", effect_code, self.from_code.in_features)
            hidden = hidden + self.from_code(effect_code).unsqueeze(-2)
        elif effect_code is not None:
            raise ValueError("this prior takes no effect code, as it was made without an effect_dimension")
        objects = self.objects(hidden.relu_()) * state.mask.unsqueeze(-1)
        return objects, self.scene(objects.sum(-2))


class LearnedPrior(Part):
    """Base class of learned priors. For their dimensions see `Prior`; `width`: of all layers."""

    def __init__(
        self,
        *,
        space: Space,
        dimension: int = 16,
        feature_dimension: int = 64,
        effect_dimension: int | None = None,
        width: int = 32,
    ) -> None:
        super().__init__()
        self.dimension = dimension
        self.context = SceneContext(
            space, feature_dimension=feature_dimension, effect_dimension=effect_dimension, width=width
        )
