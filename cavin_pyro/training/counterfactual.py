"""The published code's counterfactual term, for an ablation (the published implementation).

The paper's objective has no such term: it asserts that the actions of (s, c, z) lead to h(s, c).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from models.model import Model
from models.state import Window


def counterfactual_loss(model: Model, window: Window, codes: Mapping[str, Any]) -> Tensor:
    """Negative log density of s' around f's prediction for the generated actions, summed over the windows `[B]`.

    a = mean of g(. | s, c, z), s_t+1 = mean of f(. | s_t, a_t) for t = 0, ..., T - 1, and s_T is compared with
    s' under the likelihood scales. Objects count that are real in both, windows where `sequence_mask` is set.

    Args:
        codes: the sampled `effect_code` and `motion_code`, those of the two that the model has.
    """
    state, last = window.first, window.last
    for action in model.actions(state, **codes).unbind(-2):
        state = model.next_state(state, action)
    real = window.first.mask & last.mask
    scored = model.scales.centers(state, real).log_prob(last.centers)
    scored = scored + model.scales.features(state, real).log_prob(last.features)
    return -scored.where(window.sequence_mask, 0.0).sum()
