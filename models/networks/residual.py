"""A deeper f, for worlds where what follows changes abruptly with the state, such as at the edge of a contact."""

from __future__ import annotations

import math
from functools import reduce
from operator import add

import torch
from torch import Tensor, nn

from cavin_pyro.models.networks.dynamics import Outcome
from cavin_pyro.models.networks.layers import neighbours
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State

OCTAVES = 7  # of waves over the space, the longest of two `subgoal_range`


class ResidualDynamics(Outcome):
    """f: the mean of the state after one action, by residual layers for each object.

    own_i      = what networks read of position i, its waves from the space's origin, and its feature
    relation_i = sum over other real objects j of ReLU(linear of own_i + linear of own_j)
    x_i        = linear of own_i + linear of relation_i + linear of the action
    x_i        = x_i + linear of SiLU(linear of LayerNorm(x_i)), `depth` times
    change of position and feature i = linear of x_i, in units of `length` and of 1

    Equivariant to the order of objects; padding does not change. It takes no features of the state encoder.
    """

    reads_encoding = False

    def __init__(
        self, space: Space, *, feature_dimension: int = 64, width: int = 64, hidden: int = 256, depth: int = 3
    ) -> None:
        """`hidden`: width of the layers. `depth`: number of residual layers. `width`: of the encoder, not read."""
        super().__init__()
        self.space, self.parts = space, (space.positions, feature_dimension)
        inputs = space.inputs + 2 * OCTAVES * space.positions + feature_dimension
        self.own = nn.Linear(inputs, hidden)
        self.first, self.second = nn.Linear(inputs, hidden), nn.Linear(inputs, hidden, bias=False)
        self.relation = nn.Linear(hidden, hidden, bias=False)
        self.action = nn.Linear(space.actions, hidden, bias=False)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(hidden), nn.Linear(hidden, hidden), nn.SiLU(), nn.Linear(hidden, hidden))
            for _ in range(depth)
        )
        self.head = nn.Linear(hidden, sum(self.parts))

    def outcome(self, state: State, encoded: Tensor | None, action: Tensor) -> tuple[State, Tensor | None]:
        """The mean; it predicts no scales."""
        space = self.space
        place = space.from_origin(state.centers) * (space.length / space.subgoal_range)
        waves = [2.0**octave * math.pi * place for octave in range(OCTAVES)]
        seen = space.describe(state, space.locate(state))
        own = torch.cat([seen, *[one.sin() for one in waves], *[one.cos() for one in waves], state.features], -1)
        x = self.own(own) + self.action(space.turn_actions(action, state, dims=0)).unsqueeze(-2)
        first, second = self.first(own), self.second(own)
        related = [
            (first + other.of(second)).relu() * other.real.unsqueeze(-1)
            for other in neighbours(state.centers, state.mask, self.neighbours)
        ]
        if related:
            x = x + self.relation(reduce(add, related))
        for block in self.blocks:
            x = x + block(x)
        motion, turn = (self.head(x) * state.mask.unsqueeze(-1)).split(self.parts, -1)
        centers = state.centers + space.turn(space.length * motion, state, back=True)
        features = space.project(state.features + space.turn(turn, state, back=True))
        return State(centers, features, state.mask.expand(centers.shape[:-1])), None
