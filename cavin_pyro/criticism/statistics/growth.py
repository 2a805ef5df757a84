"""Errors of predictions over many segments."""

from __future__ import annotations

from typing import Any

import torch
from pyro import poutine
from torch import Tensor

from cavin_pyro.criticism.recordings import Recording
from guides.guide import Guide
from models.model import Model
from models.state import Window
from planning.rollouts.dynamics import predict_states

PREDICTORS = ("f", "h", "nothing_moves")
QUARTILES = (0.25, 0.5, 0.75)


def errors_over_segments(model: Model, guide: Guide, recording: Recording, segment_length: int) -> dict[str, Tensor]:
    """Mean distance of centres after each of K segments, for each of the `PREDICTORS` that the model has.

    f: f under the recorded pushes. h: h, one inferred effect code per segment. nothing_moves: the first state.

    Args:
        recording: of E episodes of S pushes; K = S // segment_length.

    Returns:
        `[E, K]` metres each, NaN where an episode has ended or no object is observed.
    """
    states, T = recording.states, segment_length
    count = recording.actions.shape[1] // T
    first = states.step(0)
    _, path = predict_states(model, first.expand_plans(1), recording.actions[:, : count * T].unsqueeze(1))
    centers = {"f": path[:, 0, T - 1 :: T], "nothing_moves": first.centers.unsqueeze(1).expand(-1, count, -1, -1)}
    if "effect_code" in model.codes:
        subgoals, state = [], first
        for begin in range(0, count * T, T):
            state = model.subgoal(state, _inferred_effect(guide, _window(recording, begin, begin + T)))
            subgoals.append(state.centers)
        centers["h"] = torch.stack(subgoals, 1)
    ends = slice(T, count * T + 1, T)
    real, observed = states.centers[:, ends], recording.observed[:, ends]
    return {name: _mean_distance(centers[name], real, observed) for name in PREDICTORS if name in centers}


def _window(recording: Recording, begin: int, end: int) -> Window:
    actions = recording.actions[:, begin:end]
    everywhere = torch.ones(actions.shape[:-1], dtype=torch.bool)
    return Window(recording.states.step(slice(begin, end + 1)), actions, everywhere, everywhere[:, 0])


def _inferred_effect(guide: Guide, window: Window) -> Tensor:
    """The guide's effect code for each window: its mean, or a sample where the distribution has none."""
    site: Any = poutine.trace(guide).get_trace(window).nodes["effect_code"]
    try:
        return site["fn"].mean
    except NotImplementedError:
        return site["value"]


def _mean_distance(predicted: Tensor, real: Tensor, observed: Tensor) -> Tensor:
    """Of centres `[E, K, M, 3]`, over the objects that are `observed: [E, K, M]`: `[E, K]` metres; NaN without any."""
    distance = (predicted - real).norm(dim=-1)
    return distance.masked_fill(~observed, torch.nan).nanmean(-1)


def farthest_moves(recording: Recording, T: int) -> Tensor:
    """The farthest move of an object over each segment: `[E, K]` metres, NaN where it was not made."""
    centers, observed = recording.states.centers[:, ::T], recording.observed[:, ::T]
    moves = (centers[:, 1:] - centers[:, :-1]).norm(dim=-1)
    both = observed[:, 1:] & observed[:, :-1]
    return moves.masked_fill(~both, -1.0).amax(-1).masked_fill(~both.any(-1), torch.nan)


def summary(errors: Tensor) -> dict[str, float]:
    """Of errors `[E]` after one segment: count of episodes, mean and quartiles in metres."""
    finite = errors[errors.isfinite()]
    if len(finite) == 0:
        return {"count": 0} | dict.fromkeys(("mean", "q25", "median", "q75"), float("nan"))
    low, median, high = torch.quantile(finite, finite.new_tensor(QUARTILES)).tolist()
    return {"count": len(finite), "mean": finite.mean().item(), "q25": low, "median": median, "q75": high}
