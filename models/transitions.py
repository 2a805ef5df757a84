"""The sites of the dynamics f and the meta-dynamics h in Pyro programs (paper, equations 1 and 2)."""

from __future__ import annotations

from typing import Any

import pyro
import torch
from torch import Tensor

from models.likelihoods import Scales
from models.networks.dynamics import PushOutcome
from models.networks.encoder import StateEncoder
from models.networks.layers import unit
from models.state import State, Window, stack_steps


def sample_subgoal(scales: Scales, mean: State, window: Window, generate: bool) -> None:
    """s' ~ h(. | s, c) for `window: [B]` around `mean: [..., B]`, observed unless `generate`.

    Sites subgoal_centers, event `[M, 3]`, and subgoal_features, event `[M, F]`. They count the objects
    that are real in s and s', or in s alone if s' is sampled.
    """
    first, last = window.first, window.last
    counted = first.mask if generate else first.mask & last.mask
    pyro.sample("subgoal_centers", scales.centers(mean, counted), obs=None if generate else last.centers)
    pyro.sample("subgoal_features", scales.features(mean, counted), obs=None if generate else last.features)


def observe_transitions(dynamics: PushOutcome, scales: Scales, window: Window, encoded: Tensor) -> None:
    """s_t+1 ~ f(. | s_t, a_t) at the T observed transitions of `window: [B]`, all at once.

    Sites next_centers, event `[T, M, 3]`, and next_features, event `[T, M, F]`. They count the transitions
    in `transition_mask`, with the objects that are real before and after the push.

    Args:
        encoded: `[B, T, M, 3 * width]`, features of the T states before each push.
    """
    before, after = window.states.step(slice(0, -1)), window.states.step(slice(1, None))
    mean, predicted = _outcome(dynamics, before, encoded, window.actions)
    counted = before.mask & after.mask & window.transition_mask.unsqueeze(-1)
    pyro.sample("next_centers", scales.centers(mean, counted, event_dims=2, **predicted), obs=after.centers)
    pyro.sample("next_features", scales.features(mean, counted, event_dims=2, **predicted), obs=after.features)


def generate_transitions(
    dynamics: PushOutcome, encoder: StateEncoder, scales: Scales, state: State, actions: Tensor
) -> None:
    """Sample s_t+1 ~ f(. | s_t, a_t) push by push from `state: [B]` under `actions: [..., B, T, 4]`.

    Sites next_centers_t and next_features_t for t = 1, ..., T; next_centers and next_features record all of
    them, in the shapes of `observe_transitions`. Sampled features are scaled to unit length before f reads them, like
    observed ones.
    """
    samples = []
    for step, action in enumerate(actions.unbind(-2), start=1):
        encoded = encoder(state) if dynamics.reads_encoding else None
        mean, predicted = _outcome(dynamics, state, encoded, action)
        centers = pyro.sample(f"next_centers_{step}", scales.centers(mean, state.mask, **predicted))
        features = pyro.sample(f"next_features_{step}", scales.features(mean, state.mask, **predicted))
        samples.append(State(centers, features, state.mask.expand(centers.shape[:-1])))
        state = samples[-1]._replace(features=unit(features))
    steps = stack_steps(samples)
    for name, made in (("next_centers", steps.centers), ("next_features", steps.features)):
        recorded = pyro.deterministic(name, made, event_dim=3)
        if recorded is not made and not torch.equal(recorded, made):
            raise ValueError(
                f"{name} only records what generation has sampled, so it cannot be conditioned or intervened on: "
                f"use {name}_1, ..., {name}_{len(samples)}"
            )


def _outcome(
    dynamics: PushOutcome, state: State, encoded: Tensor | None, action: Tensor
) -> tuple[State, dict[str, Any]]:
    """The mean of f, and `predicted` for `Scales` where f predicts scales."""
    mean, predicted = dynamics.outcome(state, encoded, action)
    return mean, {} if predicted is None else {"predicted": predicted}
