"""The decoders: dynamics f, meta-dynamics h and action generator g (paper, equations 1 to 3, appendix A.1)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.models.networks.layers import ObjectPool, fully_connected, unit
from cavin_pyro.models.part import Part
from cavin_pyro.models.state import State

PUSH_RANGE = 0.15  # metres, maximum displacement by one push along an axis
SUBGOAL_RANGE = 0.5  # metres, maximum displacement by a segment along an axis
START_LIMIT = 5.0  # normalised; soft clip of starts, far outside of the reachable box [-1, 1]


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
    feature' = unit(feature + gate * change of feature)
    """

    def __init__(self, *, maximum_displacement: float, feature_dimension: int = 64, width: int = 64) -> None:
        super().__init__()
        self.maximum_displacement = maximum_displacement  # metres, along each axis
        self.parts = (1, 3, feature_dimension)
        self.head = nn.Linear(width, sum(self.parts))

    def forward(self, state: State, effect: Tensor) -> State:
        """`effect: [..., M, width]` -> predicted state; leading dimensions broadcast, padding does not change."""
        gate, motion, turn = self.head(effect).split(self.parts, -1)
        gate = gate.sigmoid() * state.mask.unsqueeze(-1)
        centers = state.centers + gate * (
            self.maximum_displacement * motion.contiguous().tanh()
        )  # tanh is slow on tensors that are not contiguous
        features = unit(state.features + gate * turn)
        return State(centers, features, state.mask.expand(centers.shape[:-1]))


class PushOutcome(Part, ABC):
    """Base class of f, the state after one push.

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
        """The mean: `state: [...]`, its features `encoded: [..., M, 3 * width]`, `action: [..., 4]` -> `[...]`."""
        return self.outcome(state, encoded, action)[0]

    @abstractmethod
    def outcome(self, state: State, encoded: Tensor | None, action: Tensor) -> tuple[State, Tensor | None]:
        """The mean, and if `predicts_scales` the scales `[..., M, 2]` of its centres (metres) and features."""


class Dynamics(PushOutcome):
    """f as in the paper: the mean of the state after one push."""

    def __init__(
        self, *, feature_dimension: int = 64, width: int = 64, maximum_displacement: float = PUSH_RANGE
    ) -> None:
        """The layers.

        Args:
            feature_dimension: F, numbers of an object's geometric feature.
            width: width of all layers.
            maximum_displacement: largest displacement of an object's centre by one push, along each axis, in metres.
        """
        super().__init__()
        self.trunk = EffectTrunk(4, width=width, encoder_width=width)
        self.change = StateChange(
            maximum_displacement=maximum_displacement, feature_dimension=feature_dimension, width=width
        )

    def outcome(self, state: State, encoded: Tensor | None, action: Tensor) -> tuple[State, Tensor | None]:
        """The mean; it predicts no scales."""
        assert encoded is not None
        return self.change(state, self.trunk(encoded, action)), None


class MetaDynamics(nn.Module):
    """h: mean of the subgoal, the state T pushes ahead, given an effect code."""

    def __init__(self, *, effect_dimension: int = 16, feature_dimension: int = 64, width: int = 64) -> None:
        super().__init__()
        self.trunk = EffectTrunk(effect_dimension, width=width, encoder_width=width)
        self.change = StateChange(maximum_displacement=SUBGOAL_RANGE, feature_dimension=feature_dimension, width=width)

    def effect(self, encoded: Tensor, effect_code: Tensor) -> Tensor:
        """Effect feature of (s, c): `[..., M, width]`. The action generator reads it too."""
        return self.trunk(encoded, effect_code)

    def forward(self, state: State, effect: Tensor) -> State:
        """`effect: [..., M, width]` of (s, c) -> subgoal `State [...]`."""
        return self.change(state, effect)


class ActionGenerator(nn.Module):
    """g: mean of the T pushes (x, y, dx, dy) of a segment.

    pooled      = softmax-weighted mean of the effect features of (s, c) over real objects
    transformed = mean(pooled) + scale(pooled) * z
    starts      = 5 tanh(x / 5) of FC(transformed), motions = tanh of FC(transformed)

    With `motion_dimension=None` there is no motion code, and the pushes depend on the pooled feature only.
    """

    def __init__(self, *, segment_length: int = 3, motion_dimension: int | None = 16, width: int = 64) -> None:
        super().__init__()
        self.pool = ObjectPool(width)
        self.transform = None if motion_dimension is None else nn.Linear(width, 2 * motion_dimension)
        inputs = motion_dimension or width
        self.starts = _coordinates(inputs, segment_length, width)
        self.motions = _coordinates(inputs, segment_length, width)

    def forward(self, effect: Tensor, mask: Tensor, motion_code: Tensor | None = None) -> Tensor:
        """`effect: [..., M, width]`, `mask: [..., M]`, `motion_code: [..., D]` -> `[..., T, 4]`.

        Leading dimensions broadcast. Raises `ValueError` if a motion code is missing.
        """
        feature = self.pool(effect, mask)
        if self.transform is not None:
            if motion_code is None:
                raise ValueError("these pushes depend on a motion code; none was given")
            mean, scale = self.transform(feature).chunk(2, -1)
            # Softplus is ten times slower on tensors that are not contiguous.
            feature = mean + functional.softplus(scale.contiguous()) * motion_code
        starts = START_LIMIT * (self.starts(feature) / START_LIMIT).tanh()
        return torch.cat((starts, self.motions(feature).tanh()), -1)


def _coordinates(inputs: int, segment_length: int, width: int) -> nn.Sequential:
    """Two numbers for each of the T pushes: `[..., inputs] -> [..., T, 2]`."""
    return nn.Sequential(
        fully_connected(inputs, width), nn.Linear(width, 2 * segment_length), nn.Unflatten(-1, (segment_length, 2))
    )
