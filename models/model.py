"""Base classes of programs and of models, the plate over windows, and the mask of sites with codes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, ClassVar

import pyro
import torch
from pyro import poutine
from pyro.distributions import TorchDistribution
from torch import Tensor

from cavin_pyro.models.likelihoods import LikelihoodScales, PredictedScales, Scales
from cavin_pyro.models.networks.dynamics import Dynamics, PushOutcome
from cavin_pyro.models.networks.layers import StateEncoder, fixed_shapes, unit
from cavin_pyro.models.part import Part
from cavin_pyro.models.state import State, Window, stack_steps


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

    A model's `forward(window, generate=False, encoded=None)` runs its process for `window: [B]`. With `generate=True`
    it reads only the first states (and the actions, if it generates none) and samples everything else. `encoded` is the
    result of `encode(window, generate)`: a caller that runs guide and model encodes once and passes it to both.

    `codes` declares a model's latent sites, and so the methods that a planner can call, with these keywords:

    always          `next_state(state, action)`                   mean of f, `State [...]`
    "effect_code"   `effect_prior(state)`                         p(c | s), batch `[...]`, event `[C]`
                    `subgoal(state, effect_code)`                 mean of h, `State [...]`
    "motion_code"   `motion_prior(state, effect_code)`            p(z | s, c), batch `[...]`, event `[Z]`
    one or both     `actions(state, effect_code, motion_code)`    mean of g, `[..., T, 4]`

    with `state: [...]`, `effect_code: [..., C]`, `motion_code: [..., Z]`, `action: [..., 4]`, whose leading
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
        segment_length: int = 3,
        feature_dimension: int = 64,
        width: int = 64,
        maximum_objects: int = 5,
        neighbours: int | None = None,
        scales: Scales | None = None,
        dynamics: PushOutcome | None = None,
    ) -> None:
        """The dimensions and parts that all models share.

        Args:
            segment_length: T, pushes of a segment.
            feature_dimension: F, numbers of an object's geometric feature.
            width: width of all layers.
            maximum_objects: most objects in a scene of the training; other scenes may have more.
            neighbours: how many other objects, the nearest, enter each sum over other objects; None takes
                `maximum_objects - 1`, which are all others in the scenes of the training, as in the paper.
            scales: of the likelihoods; by default `LikelihoodScales()`.
            dynamics: f; by default the paper's, `Dynamics`.

        Raises:
            ValueError: scales that f must predict if it does not.
        """
        super().__init__()
        self.segment_length = segment_length
        self.feature_dimension = feature_dimension
        self.width = width
        self.maximum_objects = maximum_objects
        self.neighbours = maximum_objects - 1 if neighbours is None else neighbours
        self.scales = scales or LikelihoodScales()
        self.encoder = StateEncoder(feature_dimension=feature_dimension, width=width, neighbours=self.neighbours)
        self.dynamics: PushOutcome = dynamics or Dynamics(feature_dimension=feature_dimension, width=width)
        self.dynamics.neighbours = self.neighbours
        if isinstance(self.scales, PredictedScales) and not self.dynamics.predicts_scales:
            raise ValueError("scales=predicted needs an f that predicts them: dynamics=contact")

    @staticmethod
    def fixed_shapes() -> AbstractContextManager[None]:
        """See `cavin_pyro.models.networks.layers`: for planners that compile."""
        return fixed_shapes()

    def next_state(self, state: State, action: Tensor) -> State:
        """Mean of f: `state: [...]`, `action: [..., 4]` -> the state after one push."""
        return self.dynamics(state, self.encoder(state) if self.dynamics.reads_encoding else None, action)

    def encode(self, window: Window, generate: bool = False) -> Tensor:
        """State features of `window: [B]`: `[B, T, M, 3 * width]`, or `[B, 1, M, 3 * width]` of the first states.

        The others are needed by f alone, if it reads them and the next states are observed.

        Raises `ValueError` for windows of another shape or features of another length.
        """
        if len(window.batch_shape) != 1:
            raise ValueError(f"windows come as one batch [B]; got leading dimensions {[*window.batch_shape]}")
        if window.segment_length != self.segment_length:
            raise ValueError(
                f"window has {window.segment_length} pushes; this model was made for {self.segment_length}"
            )
        first_only = generate or not self.dynamics.reads_encoding
        return self.encoder(window.states.step(slice(0, 1) if first_only else slice(0, -1)))

    def sample_subgoal(self, mean: State, window: Window, generate: bool) -> None:
        """s' ~ h(. | s, c) for `window: [B]` around `mean: [..., B]`, observed unless `generate` (paper, equation 2).

        Sites subgoal_centers, event `[M, 3]`, and subgoal_features, event `[M, F]`. They count the objects that are
        real in s and s', or in s alone if s' is sampled.
        """
        first, last = window.first, window.last
        counted = first.mask if generate else first.mask & last.mask
        pyro.sample("subgoal_centers", self.scales.centers(mean, counted), obs=None if generate else last.centers)
        pyro.sample("subgoal_features", self.scales.features(mean, counted), obs=None if generate else last.features)

    def sample_transitions(self, window: Window, encoded: Tensor, actions: Tensor, generate: bool) -> None:
        """s_t+1 ~ f(. | s_t, a_t), observed, or sampled from the first states (paper, equation 1).

        `encoded` is the result of `encode`, `actions: [..., B, T, 4]` the input of f for sampling. Sites next_centers,
        event `[T, M, 3]`, and next_features, event `[T, M, F]`. Observed, they count the transitions in
        `transition_mask`, with the objects that are real before and after the push.
        """
        if generate:
            self._generate_transitions(window.first, actions)
            return
        if actions is not window.actions and not torch.equal(actions, window.actions):
            raise ValueError(
                "f reads the window's actions unless it generates, so the site actions cannot be conditioned or "
                "intervened on: put them into the window, or pass generate=True"
            )
        before, after = window.states.step(slice(0, -1)), window.states.step(slice(1, None))
        mean, predicted = self.dynamics.outcome(before, encoded, window.actions)
        counted = before.mask & after.mask & window.transition_mask.unsqueeze(-1)
        centers = self.scales.centers(mean, counted, event_dims=2, predicted=predicted)
        features = self.scales.features(mean, counted, event_dims=2, predicted=predicted)
        pyro.sample("next_centers", centers, obs=after.centers)
        pyro.sample("next_features", features, obs=after.features)

    def _generate_transitions(self, state: State, actions: Tensor) -> None:
        """Sample push by push from `state: [B]`, at sites next_centers_t and next_features_t for t = 1, ..., T.

        next_centers and next_features record all of them. Sampled features are scaled to unit length before f reads
        them, like observed ones.
        """
        samples = []
        for step, action in enumerate(actions.unbind(-2), start=1):
            encoded = self.encoder(state) if self.dynamics.reads_encoding else None
            mean, predicted = self.dynamics.outcome(state, encoded, action)
            centers = pyro.sample(f"next_centers_{step}", self.scales.centers(mean, state.mask, predicted=predicted))
            features = pyro.sample(f"next_features_{step}", self.scales.features(mean, state.mask, predicted=predicted))
            samples.append(State(centers, features, state.mask.expand(centers.shape[:-1])))
            state = samples[-1]._replace(features=unit(features))
        steps = stack_steps(samples)
        for name, sampled in (("next_centers", steps.centers), ("next_features", steps.features)):
            recorded = pyro.deterministic(name, sampled, event_dim=3)
            if recorded is not sampled and not torch.equal(recorded, sampled):
                raise ValueError(
                    f"{name} only records what generation has sampled, so it cannot be conditioned or intervened on: "
                    f"use {name}_1, ..., {name}_{len(samples)}"
                )


def windows_plate(window: Window) -> AbstractContextManager:
    """The plate over the independent windows of a batch `window: [B]`."""
    return pyro.plate("windows", len(window.actions))


def sequence_mask(window: Window) -> AbstractContextManager:
    """Masks sites by `window.sequence_mask: [B]`."""
    return poutine.mask(mask=window.sequence_mask)  # type: ignore[call-overload]
