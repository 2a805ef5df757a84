"""Base class of model programs: what each of them has."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from models.dynamics import Dynamics
from models.encoder import StateEncoder
from models.encoding import SharedEncoding
from models.likelihoods import LikelihoodScales, Scales
from models.program import Program
from models.state import State, Window
from models.transitions import generate_transitions, observe_transitions


class Model(Program):
    """A process that generates windows of experience, with the dynamics f as its last line.

    A model's `forward(window, generate=False)` runs its process for `window: [B]`. With `generate=True` only
    the first states are read (and the actions, by a model that has none of its own); all else is drawn.

    A planner calls, by these names and keywords, those of the following that a model has:

    `effect_prior(state)`                         p(c | s), batch `[...]`, event `[C]`
    `motion_prior(state, effect_code)`            p(z | s, c), batch `[...]`, event `[Z]`
    `subgoal(state, effect_code)`                 mean of h, `State [...]`
    `actions(state, effect_code, motion_code)`    mean of g, `[..., T, 4]`
    `next_state(state, action)`                   mean of f, `State [...]`

    with `state: [...]`, `effect_code: [..., C]`, `motion_code: [..., Z]`, `action: [..., 4]`, whose leading
    dimensions broadcast. A model without one of the codes takes the argument all the same, and never reads it.
    """

    name: ClassVar[str]  # what guides say that they fit

    def __init__(
        self,
        *,
        segment_length: int = 3,
        feature_dimension: int = 64,
        width: int = 64,
        maximum_objects: int = 5,
        scales: Scales | None = None,
    ) -> None:
        """T; numbers per object of a point-cloud feature; width of all layers; M at most; the likelihoods' scales."""
        super().__init__()
        self.segment_length = segment_length
        self.feature_dimension = feature_dimension
        self.width = width
        self.maximum_objects = maximum_objects
        self.scales = scales or LikelihoodScales()
        self.encoder = StateEncoder(feature_dimension=feature_dimension, width=width, maximum_objects=maximum_objects)
        self.dynamics = Dynamics(feature_dimension=feature_dimension, width=width)
        self._shared_encoding = SharedEncoding()

    def next_state(self, state: State, action: Tensor) -> State:
        """Mean of f: `state: [...]`, `action: [..., 4]` -> the state after one push."""
        return self.dynamics(state, self.encoder(state), action)

    def encode(self, window: Window, generate: bool, *, for_guide: bool = False) -> Tensor:
        """State features of `window: [B]`: `[B, T, M, 3 * width]`, or `[B, 1, M, 3 * width]` of the first states.

        What a guide asks for with `for_guide=True` is kept for the model, which needs the same.
        Raises `ValueError` for windows of another shape, more objects or features of another length.
        """
        if len(window.batch_shape) != 1:
            raise ValueError(f"windows come as one batch [B]; got leading dimensions {[*window.batch_shape]}")
        if window.segment_length != self.segment_length:
            raise ValueError(
                f"window has {window.segment_length} pushes; this model was made for {self.segment_length}"
            )
        encoder = self.encoder
        if generate:
            return encoder(window.states.step(slice(0, 1)))
        kept = None if for_guide else self._shared_encoding.take(encoder, window)
        encoded = encoder(window.states.step(slice(0, -1))) if kept is None else kept
        if for_guide:
            self._shared_encoding.keep(encoder, window, encoded)
        return encoded

    def sample_transitions(self, window: Window, encoded: Tensor, actions: Tensor, generate: bool) -> None:
        """The sites of f, observed or drawn from the first states on (see `models/transitions.py`).

        `encoded` is what `encode` has returned, `actions: [..., B, T, 4]` what f reads when drawing.
        """
        if generate:
            generate_transitions(self.dynamics, self.encoder, self.scales, window.first, actions)
        else:
            observe_transitions(self.dynamics, self.scales, window, encoded)
