"""The decoders: dynamics f, meta-dynamics h and action generator g (paper, equations 1 to 3, appendix A.1)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from cavin_pyro.models.checks import check_last
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.models.networks.layers import ObjectPool, fully_connected
from cavin_pyro.models.part import Part
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State


class EffectTrunk(nn.Module):
    """Effect feature of each object: the effect of a context (an action or an effect code) on it.

    With `context_dimension=None` there are no layers for the context: the feature depends on the state alone.
    """

    def __init__(self, context_dimension: int | None, *, width: int = 64, encoder_width: int = 64) -> None:
        super().__init__()
        self.context = None if context_dimension is None else fully_connected(context_dimension, width)
        self.from_state = nn.Linear(3 * encoder_width, width)
        self.from_context = None if context_dimension is None else nn.Linear(width, width, bias=False)
        self.second = fully_connected(width, width)

    def forward(self, encoded: Tensor, context: Tensor | None = None) -> Tensor:
        """`encoded: [..., M, 3 * encoder_width]`, `context: [..., context_dimension]` -> `[..., M, width]`.

        The leading dimensions of both broadcast.
        """
        feature = self.from_state(encoded)
        if self.context is not None and self.from_context is not None:
            # A linear layer on (state feature, context repeated per object). The context's part is computed once
            # per scene, not once per object.
            feature = feature + self.from_context(self.context(context)).unsqueeze(-2)
        return self.second(feature.relu_())


class StateChange(nn.Module):
    """Predicts the change of each object, with one gate per object.

    center'  = center + gate * maximum_displacement * tanh(change of center)
    feature' = projection of feature + gate * change of feature, such as to unit length

    In a turning space changes are in the axes of object 0.
    """

    def __init__(
        self, space: Space, *, maximum_displacement: float, feature_dimension: int = 64, width: int = 64
    ) -> None:
        super().__init__()
        self.space = space
        self.maximum_displacement = maximum_displacement  # along each axis
        self.parts = (1, space.positions, feature_dimension)
        self.head = nn.Linear(width, sum(self.parts))

    def forward(self, state: State, effect: Tensor) -> State:
        """`effect: [..., M, width]` -> predicted state; leading dimensions broadcast, padding does not change."""
        gate, motion, turn = self.head(effect).split(self.parts, -1)
        gate = gate.sigmoid() * state.mask.unsqueeze(-1)
        # tanh is slow on tensors that are not contiguous
        change = gate * (self.maximum_displacement * motion.contiguous().tanh())
        centers = state.centers + self.space.turn(change, state, back=True)
        features = self.space.project(state.features + self.space.turn(gate * turn, state, back=True))
        return State(centers, features, state.mask.expand(centers.shape[:-1]))


class Outcome(Part, ABC):
    """Base class of f, the state after one action.

    Attributes:
        geometry: the class of geometric features that it can read, None for any. reads_encoding: whether it needs the
            state encoder's features. predicts_scales: whether `outcome` has scales. neighbours: how many other objects
            may enter an object's relations, the nearest; None for all. The model sets it.
    """

    geometry: ClassVar[type[Geometry] | None] = None
    reads_encoding: ClassVar[bool] = True
    predicts_scales: ClassVar[bool] = False
    neighbours: int | None = None

    def forward(self, state: State, encoded: Tensor | None, action: Tensor) -> State:
        """The mean: `state: [...]`, its features `encoded: [..., M, 3 * width]`, `action: [..., A]` -> `[...]`."""
        return self.outcome(state, encoded, action)[0]

    @abstractmethod
    def outcome(self, state: State, encoded: Tensor | None, action: Tensor) -> tuple[State, Tensor | None]:
        """The mean, and if `predicts_scales` the scales `[..., M, 2]` of its centres and features."""


class Dynamics(Outcome):
    """f as in the paper: the mean of the state after one action."""

    def __init__(
        self, space: Space, *, feature_dimension: int = 64, width: int = 64, maximum_displacement: float | None = None
    ) -> None:
        """The layers.

        Args:
            space: of the world.
            feature_dimension: F, numbers of an object's geometric feature.
            width: width of all layers.
            maximum_displacement: of an object's centre by one action, along each axis; None takes the space's.
        """
        super().__init__()
        self.space = space
        self.trunk = EffectTrunk(space.actions, width=width, encoder_width=width)
        self.change = StateChange(
            space,
            maximum_displacement=space.step_range if maximum_displacement is None else maximum_displacement,
            feature_dimension=feature_dimension,
            width=width,
        )

    def outcome(self, state: State, encoded: Tensor | None, action: Tensor) -> tuple[State, Tensor | None]:
        """The mean; it predicts no scales."""
        assert encoded is not None
        return self.change(state, self.trunk(encoded, self.space.turn_actions(action, state, dims=0))), None


class MetaDynamics(nn.Module):
    """h: mean of the subgoal, the state T actions ahead, given an effect code."""

    def __init__(
        self, space: Space, *, effect_dimension: int = 16, feature_dimension: int = 64, width: int = 64
    ) -> None:
        super().__init__()
        self.effect_dimension = effect_dimension
        self.trunk = EffectTrunk(effect_dimension, width=width, encoder_width=width)
        self.change = StateChange(
            space, maximum_displacement=space.subgoal_range, feature_dimension=feature_dimension, width=width
        )

    def effect(self, encoded: Tensor, effect_code: Tensor) -> Tensor:
        """Effect feature of (s, c): `[..., M, width]`. The action generator reads it too."""
        check_last("effect_code", effect_code, self.effect_dimension)
        return self.trunk(encoded, effect_code)

    def forward(self, state: State, effect: Tensor) -> State:
        """`effect: [..., M, width]` of (s, c) -> subgoal `State [...]`."""
        return self.change(state, effect)


class ActionGenerator(nn.Module):
    """g: mean of the T actions of a segment.

    pooled      = softmax-weighted mean of the effect features of (s, c) over real objects
    transformed = mean(pooled) + scale(pooled) * z
    part of a   = limit * tanh(FC(transformed) / limit), for each part of an action and its limit in the space

    With `motion_dimension=None` there is no motion code, and the actions depend on the pooled feature only.
    """

    def __init__(
        self, space: Space, *, segment_length: int = 3, motion_dimension: int | None = 16, width: int = 64
    ) -> None:
        super().__init__()
        self.space = space
        self.pool = ObjectPool(width)
        self.transform = None if motion_dimension is None else nn.Linear(width, 2 * motion_dimension)
        for name, size in zip(space.action_names, space.action_sizes, strict=True):
            layers = nn.Sequential(
                fully_connected(motion_dimension or width, width),
                nn.Linear(width, size * segment_length),
                nn.Unflatten(-1, (segment_length, size)),  # `size` numbers for each of the T actions
            )
            self.add_module(f"{name}s", layers)

    def forward(self, effect: Tensor, state: State, motion_code: Tensor | None = None) -> Tensor:
        """`effect: [..., M, width]` of (s, c), `state: [...]`, `motion_code: [..., D]` -> `[..., T, A]`.

        Leading dimensions broadcast. Raises `ValueError` for a motion code of another length, or none.
        """
        feature = self.pool(effect, state.mask)
        if self.transform is not None:
            mean, scale = self.transform(feature).chunk(2, -1)
            check_last("motion_code", motion_code, mean.shape[-1])
            assert motion_code is not None
            # Softplus is ten times slower on tensors that are not contiguous.
            feature = mean + functional.softplus(scale.contiguous()) * motion_code
        parts = [
            _limited(self.get_submodule(f"{name}s")(feature), limit)
            for name, limit in zip(self.space.action_names, self.space.action_limits, strict=True)
        ]
        return self.space.turn_actions(torch.cat(parts, -1), state, back=True)


def _limited(values: Tensor, limit: float) -> Tensor:
    return values.tanh() if limit == 1 else limit * (values / limit).tanh()
