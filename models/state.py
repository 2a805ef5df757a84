"""States and windows of experience (paper, sections 2 and 3.1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class State(NamedTuple):
    """The observed state of `M` objects (padded to a fixed number) in any batch `[...]` of scenes.

    `state[0]` is the tuple's first field, not a scene: use `scene` and `step` to index.
    """

    centers: Tensor  # [..., M, P] positions, in the world's unit
    features: Tensor  # [..., M, F] what else is seen of each object, such as its geometry, of unit length, or an angle
    mask: Tensor  # [..., M] bool, True for real objects, False for padding

    @property
    def batch_shape(self) -> torch.Size:
        """Shape of the leading dimensions `[...]`."""
        return self.centers.shape[:-2]

    @property
    def objects(self) -> int:
        """`M`, padding included."""
        return self.centers.shape[-2]

    def map(self, function: Callable[[Tensor], Tensor]) -> State:
        """Apply one function to every field, for example `state.map(lambda field: field.to(device))`."""
        return State(function(self.centers), function(self.features), function(self.mask))

    def scene(self, index: int | slice | Tensor) -> State:
        """Index the first leading dimension: `[B, ...] -> [...]` or `[b, ...]`."""
        return self.map(lambda field: field[index])

    def step(self, index: int | slice) -> State:
        """Index the last leading dimension, usually time: `[..., T] -> [...]` or `[..., t]`."""
        return State(self.centers[..., index, :, :], self.features[..., index, :, :], self.mask[..., index, :])

    def expand(self, batch_shape: Sequence[int]) -> State:
        """Broadcast to leading dimensions `batch_shape`, as views without copies."""
        return State(
            self.centers.expand(*batch_shape, *self.centers.shape[-2:]),
            self.features.expand(*batch_shape, *self.features.shape[-2:]),
            self.mask.expand(*batch_shape, self.mask.shape[-1]),
        )

    def values(self, features: bool = False) -> Tensor:
        """The centres `[..., M, P]`; with `features` these behind them, `[..., M, P + F]`."""
        return torch.cat((self.centers, self.features), -1) if features else self.centers

    def expand_plans(self, plans: int) -> State:
        """One copy (a view) per plan sample: `[B] -> [B, N]`."""
        single = State(self.centers.unsqueeze(-3), self.features.unsqueeze(-3), self.mask.unsqueeze(-2))
        return single.expand((*self.batch_shape, plans))


class Window(NamedTuple):
    """One training example: `T + 1` states and the `T` actions between them, in any batch `[...]`.

    `window.initial` has the first state alone, and programs sample what they observe of a whole window.
    """

    states: State  # fields with leading [..., T + 1]; [..., 1] of an initial window
    actions: Tensor  # [..., T, A] normalised, in [-1, 1]
    transition_mask: Tensor  # [..., T] bool: transitions that count for the dynamics f
    sequence_mask: Tensor  # [...] bool: windows that count for the terms with latent variables (h and g)

    @property
    def batch_shape(self) -> torch.Size:
        """Shape of the leading dimensions `[...]`."""
        return self.actions.shape[:-2]

    @property
    def segment_length(self) -> int:
        """`T`, the number of actions."""
        return self.actions.shape[-2]

    @property
    def first(self) -> State:
        """The state s before the first action: `[...]`."""
        return self.states.step(0)

    @property
    def last(self) -> State:
        """The state s' after the last action, the subgoal reached: `[...]`."""
        return self.states.step(-1)

    @property
    def initial(self) -> Window:
        """The window without its states after the first; the actions stay, for programs that do not generate any."""
        return self._replace(states=self.states.step(slice(0, 1)))

    @property
    def whole(self) -> bool:
        """Whether states after the first are known."""
        return self.states.mask.shape[-2] > 1

    def observed(self, value: Tensor) -> Tensor | None:
        """For `obs=` of a `pyro.sample`: the value if the window is whole; None, to sample it, if it is initial."""
        return value if self.whole else None

    def map(self, function: Callable[[Tensor], Tensor]) -> Window:
        """Apply one function to every tensor, for example `window.map(lambda tensor: tensor[:8])`."""
        return Window(
            self.states.map(function),
            function(self.actions),
            function(self.transition_mask),
            function(self.sequence_mask),
        )
