"""What networks must know of a world: dimensions, units, ranges, and the axes in which they see it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import get_type_hints

import torch
from torch import Tensor
from torch.nn import functional

from cavin_pyro.models.checks import check_kinds, check_last, check_number
from cavin_pyro.models.state import State

MIRRORS = ("mirror", "mirror_features")


def unit(values: Tensor) -> Tensor:
    """Scale to unit length along the last dimension; zeros stay zeros."""
    return functional.normalize(values, dim=-1)


@dataclass(frozen=True, kw_only=True)
class Space:
    """The numbers of a world. Lengths are in its own unit; lists may stand for tuples.

    An action has A numbers, in one or more parts of different kind, such as a place and a motion.

    Attributes:
        origin: [P], the position that networks see as 0; P is the dimension of positions. length: a typical distance,
            which they see as 1.
        step_range, subgoal_range: the most that f in a step, and h in a segment, moves a position along an axis;
            by default three steps.
        action_sizes: how many numbers each part of an action has; A is their sum. action_names: of the parts.
        action_limits: of g's means, approached softly: 1 is the border of the action box.
        center_scale, feature_scale, action_scales: standard deviations of the likelihoods, one for each part; that of
            positions is by default a fiftieth of the length.
        unit_features: how many numbers of a feature, from the first, are a vector of unit length; the others are free.
            None: all.
        turning: networks see positions from object 0, and all vectors in its axes: its feature begins with the cosine
            and the sine of its angle. The first two numbers of positions, features and each part of actions turn.
        frequencies: of sines and cosines of positions that networks also read, of wavelengths 2, 1, 1/2 ... lengths.
        mirror: [P] signs of positions from the origin, and of the parts of actions likewise, under which the world is
            the same, as (1, -1, 1) in a plane; empty: none. mirror_features: [F] of features, if no geometry tells.

    Raises ValueError: a number out of range, or parts of different number.
    """

    origin: Sequence[float]
    length: float
    step_range: float
    subgoal_range: float = 0.0
    action_sizes: Sequence[int]
    action_names: Sequence[str] = ("action",)
    action_limits: Sequence[float] = (1.0,)
    center_scale: float = 0.0
    feature_scale: float = 0.1
    action_scales: Sequence[float] = (0.1,)
    unit_features: int | None = None
    turning: bool = False
    frequencies: int = 0
    mirror: Sequence[float] = field(default=(), compare=False)
    mirror_features: Sequence[float] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        check_kinds(vars(self), get_type_hints(type(self)))
        for name in ("origin", "action_sizes", "action_names", "action_limits", "action_scales", *MIRRORS):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        parts = (self.action_names, self.action_limits, self.action_scales)
        if not self.action_sizes or any(len(one) != len(self.action_sizes) for one in (*parts, {*self.action_names})):
            raise ValueError(
                f"a space has different names, limits and scales for each of its {len(self.action_sizes)} action parts"
            )
        for name in ("length", "step_range", "feature_scale", "action_limits", "action_scales"):
            given = getattr(self, name)
            for value in given if isinstance(given, tuple) else [given]:
                check_number(f"{name} of a space", value, 1e-30, 1e30)  # torch counts in float32
        for name, usual in (("subgoal_range", 3.0 * self.step_range), ("center_scale", self.length / 50)):
            check_number(f"{name} of a space", getattr(self, name))
            object.__setattr__(self, name, getattr(self, name) or usual)
        if self.subgoal_range < self.step_range:
            raise ValueError(f"subgoal_range of a space is at least its step_range, not {self.subgoal_range:g}")
        if self.mirror and (len(self.mirror) != self.positions or max(self.action_sizes) > self.positions):
            raise ValueError("mirror of a space has P signs, and actions in parts of no more numbers")
        if {*self.mirror, *self.mirror_features} - {-1, 1}:
            raise ValueError("mirror and mirror_features of a space are signs, 1 or -1")
        for value in self.origin:
            check_number("origin of a space", value, -1e30, 1e30)
        for value in self.action_sizes:
            check_number("action_sizes of a space", value, 1, whole=True)
        check_number("unit_features of a space", self.unit_features or 0, whole=True)
        check_number("frequencies of a space", self.frequencies, 0, 24, whole=True)  # float32 tells no shorter waves
        if not self.origin:
            raise ValueError("a space has an origin [P] of at least a number")
        if self.turning and (self.positions < 2 or any(size != 2 for size in self.action_sizes)):
            raise ValueError("a turning space has positions of at least 2 numbers, and actions in parts of 2")

    @property
    def positions(self) -> int:
        """P, numbers of a position."""
        return len(self.origin)

    @property
    def actions(self) -> int:
        """A, numbers of an action."""
        return sum(self.action_sizes)

    @property
    def inputs(self) -> int:
        """How many numbers networks read of a position (`describe`)."""
        seen = self.positions * (1 + 2 * self.frequencies)
        return seen + self.positions if self.turning else seen

    def check(self, state: State, features: int) -> None:
        """Raise ValueError unless a state has positions of P numbers, and features of so many."""
        check_last("centers of a state", getattr(state, "centers", state), self.positions)
        check_last("features of a state", state.features, features)

    def project(self, features: Tensor) -> Tensor:
        """Features `[..., F]` as observed ones are: the first `unit_features` numbers of unit length."""
        if self.unit_features is None:
            return unit(features)
        return torch.cat((unit(features[..., : self.unit_features]), features[..., self.unit_features :]), -1)

    def locate(self, state: State) -> Tensor:
        """Positions `[..., M, P]` from the origin, or from object 0 in its axes, in units of `length`."""
        if not self.turning:
            return self.from_origin(state.centers)
        return self.turn((state.centers - state.centers[..., :1, :]) / self.length, state)

    def describe(self, state: State, located: Tensor) -> Tensor:
        """What networks read of positions that are `located: [..., M, P]`: `[..., M, inputs]`."""
        waves = [2.0**octave * math.pi * located for octave in range(self.frequencies)]
        parts = [located, *[wave.sin() for wave in waves], *[wave.cos() for wave in waves]]
        if self.turning:
            parts.append(self.from_origin(state.centers))
        return torch.cat(parts, -1) if len(parts) > 1 else located

    def turn(self, vectors: Tensor, state: State, *, back: bool = False, dims: int = 1) -> Tensor:
        """Vectors `[..., n, D]` in the axes of object 0 of `state: [...]`, or `back` in the world's.

        Their first two numbers turn. `dims`: of n, 1 or 0. Without `turning` they stay as they are.
        """
        if not self.turning:
            return vectors
        cosine, sine = (state.features[(..., 0, number, *dims * [None])] for number in (0, 1))
        if back:
            sine = -sine
        x, y = vectors[..., 0], vectors[..., 1]
        turned = torch.stack((x * cosine + y * sine, y * cosine - x * sine), -1)
        return torch.cat((turned, vectors[..., 2:]), -1) if vectors.shape[-1] > 2 else turned

    def turn_actions(self, actions: Tensor, state: State, *, back: bool = False, dims: int = 1) -> Tensor:
        """As `turn`, for each part of actions `[..., n, A]`."""
        if not self.turning:
            return actions
        parts = actions.split(list(self.action_sizes), -1)
        return torch.cat([self.turn(part, state, back=back, dims=dims) for part in parts], -1)

    def from_origin(self, centers: Tensor) -> Tensor:
        """Positions `[..., M, P]` from the origin, in units of `length`."""
        # Raw coordinates may differ by a few hundredths of their size; centring and scaling makes such differences
        # visible to a network. Filled where the centres are: a copy from the CPU would let a GPU wait, and CUDA graphs
        # have none.
        origin = torch.cat([centers.new_full((1,), coordinate) for coordinate in self.origin])
        return (centers - origin) / self.length
