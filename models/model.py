"""Base classes of programs and of models, the plate over windows, and the mask of sites with codes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import pyro
import torch
from pyro import poutine
from pyro.distributions import TorchDistribution
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch import Tensor

from cavin_pyro.models.checks import check_last, told, typed
from cavin_pyro.models.likelihoods import LikelihoodScales, PredictedScales, Scales
from cavin_pyro.models.networks.dynamics import Dynamics, Outcome
from cavin_pyro.models.networks.layers import StateEncoder, fixed_shapes
from cavin_pyro.models.part import Part
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State, Window


class Program(Part):
    """A Pyro program whose networks are its submodules.

    Each call registers the parameters with `pyro.module`, because `SVI` and Pyro's optimizers find them in Pyro's
    parameter store. `pyro.settings.set(module_local_params=True)` disables the store: `Trace_ELBO()(model, guide)` is
    then an ordinary module for a torch optimizer, and calls skip the registration, about a tenth of a training step.
    """

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if not pyro.settings.get("module_local_params"):
            pyro.module(type(self).__name__, self)
        return super().__call__(*args, **kwargs)


class Model(Program):
    """A process that generates windows of experience, with the dynamics f as its last line.

    A model's `forward(window)` runs its process for `window: [B]`, a batch of training examples. Of `window.initial` it
    reads only the first states (and the actions, if it generates none) and samples everything else. It raises
    `ValueError` for windows of another shape or features of another length.

    `codes` declares a model's latent sites, and so the methods that a planner can call, with these keywords:

    always          `next_state(state, action)`                   mean of f, `State [...]`
    "effect_code"   `effect_prior(state)`                         p(c | s), batch `[...]`, event `[C]`
                    `subgoal(state, effect_code)`                 mean of h, `State [...]`
    "motion_code"   `motion_prior(state, effect_code)`            p(z | s, c), batch `[...]`, event `[Z]`
    one or both     `actions(state, effect_code, motion_code)`    mean of g, `[..., T, A]`

    with `state: [...]`, `effect_code: [..., C]`, `motion_code: [..., Z]`, `action: [..., A]`, whose leading
    dimensions broadcast. A model without one of the codes accepts the argument and ignores it.
    """

    name: ClassVar[str]  # which guides list in `fits`
    codes: ClassVar[tuple[str, ...]]  # names of the latent sites, in their order

    # Only in models with these codes:
    effect_dimension: int  # C
    motion_dimension: int  # Z
    effect_prior: Callable[..., TorchDistribution]
    motion_prior: Callable[..., TorchDistribution]
    subgoal: Callable[..., State]
    actions: Callable[..., Tensor]

    def __init__(
        self,
        *,
        space: Space,
        segment_length: int = 3,
        feature_dimension: int = 64,
        width: int = 64,
        maximum_objects: int = 5,
        neighbours: int | None = None,
        scales: Scales | None = None,
        dynamics: Outcome | None = None,
    ) -> None:
        """The dimensions and parts that all models share.

        Args:
            space: of the world: dimensions, units and ranges.
            segment_length: T, actions of a segment.
            feature_dimension: F, numbers of an object's geometric feature.
            width: width of all layers.
            maximum_objects: most objects in a scene of the training; other scenes may have more.
            neighbours: how many other objects, the nearest, enter each sum over other objects; None takes
                `maximum_objects - 1`, which are all others in the scenes of the training, as in the paper.
            scales: of the likelihoods; by default the space's, `LikelihoodScales`.
            dynamics: f; by default the paper's, `Dynamics`.

        Raises:
            ValueError: a number out of range, or scales that f must predict if it does not.
        """
        super().__init__()
        self._encoding: tuple[Window, Tensor] | None = None
        self.space = space
        self.segment_length = segment_length
        self.feature_dimension = feature_dimension
        self.width = width
        self.maximum_objects = maximum_objects
        self.neighbours = maximum_objects - 1 if neighbours is None else neighbours
        self.scales = scales or LikelihoodScales(space)
        sizes = {"feature_dimension": feature_dimension, "width": width}
        self.encoder = StateEncoder(space, neighbours=self.neighbours, **sizes)
        self.dynamics: Outcome = dynamics or Dynamics(space, **sizes)
        self.dynamics.neighbours = self.neighbours
        if isinstance(self.scales, PredictedScales) and not self.dynamics.predicts_scales:
            raise ValueError("scales=predicted needs an f that predicts them: dynamics=contact")
        if (space.unit_features or 0) > feature_dimension:
            raise ValueError(f"a feature has {feature_dimension} numbers, and the space's unit_features are more")

    @property
    def action_dimension(self) -> int:
        """A, the numbers of an action."""
        return self.space.actions

    @staticmethod
    def fixed_shapes() -> AbstractContextManager[None]:
        """See `cavin_pyro.models.networks.layers`: for planners that compile."""
        return fixed_shapes()

    def check_priors(self) -> None:
        """Raise ValueError unless each code has a prior that gives distributions of it, here for a scene `[1]`."""
        one = next(self.parameters()).new_zeros
        state = State(
            one(1, 1, self.space.positions), one(1, 1, self.feature_dimension), one(1, 1).bool().logical_not()
        )
        for code in self.codes:
            name = code.replace("code", "prior")
            if not hasattr(self, name):  # which planners need, not trainings
                continue
            effect = [one(1, getattr(self, "effect_dimension", 0))] if code == "motion_code" else []
            try:
                with torch.no_grad(), torch.random.fork_rng(devices=[]):
                    made = getattr(self, name)(state, *effect)
            except Exception as error:
                said = (str(error).splitlines() or [repr(error)])[0]
                raise ValueError(f"{name} fails for a scene [1]: {said}") from error
            wanted = [1, getattr(self, code.replace("code", "dimension"))]
            known = isinstance(made, TorchDistributionMixin)
            if not known or [*made.batch_shape, *made.event_shape] != wanted:
                given = f"{type(made).__name__} {[*made.batch_shape]} {[*made.event_shape]}" if known else told(made)
                said = f"{name} must give, for a scene [1], a distribution of Pyro with batch and event shape"
                raise ValueError(f"{said} [1] {wanted[1:]}, not {given}")

    def next_state(self, state: State, action: Tensor) -> State:
        """Mean of f: `state: [...]`, `action: [..., A]` -> the state after one action."""
        self.space.check(state, self.feature_dimension)
        check_last("action", action, self.space.actions)
        return self.dynamics(state, self.encoder(state) if self.dynamics.reads_encoding else None, action)

    @typed(ValueError)
    def encode(self, window: Window) -> Tensor:
        """State features of `window: [B]`: `[B, T, M, 3 * width]`, or `[B, 1, M, 3 * width]` of the first states.

        The others are needed by f alone, if it reads them and the next states are observed.

        Raises `ValueError` for windows of another shape or features of another length.
        """
        if self._encoding is not None and self._encoding[0] is window:
            return self._encoding[1]
        shape, steps = [*window.batch_shape], window.states.mask.shape[:-1]
        if len(shape) != 1 or shape == [0] or len(steps) != 2:
            raise ValueError(f"windows come as one batch [B] with states [B, T + 1], not {shape} with {[*steps]}")
        self.space.check(window.first, self.feature_dimension)
        check_last("actions of a window", window.actions, self.space.actions)
        if window.segment_length != self.segment_length:
            raise ValueError(
                f"window has {window.segment_length} actions; this model was made for {self.segment_length}"
            )
        all_steps = window.whole and self.dynamics.reads_encoding
        return self.encoder(window.states.step(slice(0, -1) if all_steps else slice(0, 1)))

    @contextmanager
    def encoding(self, window: Window) -> Iterator[None]:
        """Within, model and guide share one encoding of this window object, which training needs only once."""
        self._encoding = (window, self.encode(window))
        try:
            yield
        finally:
            self._encoding = None

    def generate(self, window: Window) -> None:
        """Run the process for the first states of `window: [B]`: it samples all that it would observe.

        A program as any other, so `Predictive(model.generate, guide=guide, num_samples=20)(window)` infers the codes
        from whole windows and generates from these.
        """
        self(window.initial)

    def transitions(self, window: Window, encoded: Tensor, actions: Tensor) -> Iterator[DynamicsStep]:
        """f's likelihoods for `window: [B]`, encoded by `encode`, and `actions: [..., B, T, A]` (paper, equation 1).

        Of a whole window one, for all T actions at once: events `[T, M, P]` and `[T, M, F]`. It counts the transitions
        in `transition_mask`, with the objects that are real before and after the action. Of an initial window T, one
        after the other: events `[M, P]` and `[M, F]`. f reads the `sampled` state of each before the next, its features
        projected, such as to unit length, like observed ones.
        """
        if window.whole:
            before, after = window.states.step(slice(0, -1)), window.states.step(slice(1, None))
            counted = before.mask & after.mask & window.transition_mask.unsqueeze(-1)
            mean, scales = self.dynamics.outcome(before, encoded, actions)
            yield DynamicsStep("", *self._likelihoods(mean, counted, scales, 2), after.centers, after.features)
            return
        state = window.first
        for number, action in enumerate(actions.unbind(-2), start=1):
            features = self.encoder(state) if self.dynamics.reads_encoding else None
            mean, scales = self.dynamics.outcome(state, features, action)
            step = DynamicsStep(f"_{number}", *self._likelihoods(mean, state.mask, scales, 1))
            yield step
            centers, sampled = step.sampled
            state = State(centers, self.space.project(sampled), state.mask.expand(centers.shape[:-1]))

    def _likelihoods(
        self, mean: State, counted: Tensor, scales: Tensor | None, event_dims: int
    ) -> tuple[TorchDistribution, TorchDistribution]:
        return (
            self.scales.centers(mean, counted, event_dims=event_dims, predicted=scales),
            self.scales.features(mean, counted, event_dims=event_dims, predicted=scales),
        )


@dataclass
class DynamicsStep:
    """f's likelihoods of all steps of a window, or of one: for the sites next_centers and next_features.

    suffix: of the sites' names: none, or _1, ..., _T. observed_centers, observed_features: None if they are sampled.
    sampled: centres and features, for the program to set before it asks for the next transition.
    """

    suffix: str
    centers: TorchDistribution
    features: TorchDistribution
    observed_centers: Tensor | None = None
    observed_features: Tensor | None = None
    sampled: tuple[Tensor, Tensor] = ()  # type: ignore[assignment]


def windows_plate(window: Window) -> AbstractContextManager:
    """The plate over the independent windows of a batch `window: [B]`."""
    return pyro.plate("windows", len(window.actions))


def sequence_mask(window: Window) -> AbstractContextManager:
    """Masks sites by `window.sequence_mask: [B]`."""
    return poutine.mask(mask=window.sequence_mask)  # type: ignore[call-overload]
