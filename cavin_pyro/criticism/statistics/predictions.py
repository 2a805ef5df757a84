"""Samples of f's and h's predictions on held-out windows, and their scores: PIT, coverage, CRPS, errors.

Gneiting, Balabdaoui and Raftery, "Probabilistic forecasts, calibration and sharpness", 2007. Samples suit every
likelihood, also a user's own and mixtures over codes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from pyro import poutine
from pyro.ops.stats import crps_empirical, energy_score_empirical
from torch import Tensor

from cavin_pyro.criticism.statistics.clusters import Interval, bootstrap_interval
from cavin_pyro.criticism.statistics.pushing import MOVED
from cavin_pyro.criticism.statistics.windows import repeated
from guides.guide import Guide
from models.model import Model
from models.state import Window

LEVELS = (0.5, 0.8, 0.9, 0.95)  # of central intervals
AXES = ("x", "y", "z")
FEATURES = 8  # components of a feature to evaluate, a fixed random choice


class Prediction(NamedTuple):
    """Samples of the states after a push (f, `...` is B, T) or a segment (h, `...` is B), and those observed."""

    centers: Tensor  # [S, ..., M, 3] metres
    features: Tensor  # [S, ..., M, 8]
    real_centers: Tensor  # [..., M, 3] metres
    real_features: Tensor  # [..., M, 8]
    counted: Tensor  # [..., M] bool, objects that are real before and after
    moved: Tensor  # [..., M] bool, of these, those that went farther than 1 cm


def has_subgoals(model: Model, window: Window) -> bool:
    """Whether the program has an h, for windows `[B]`."""
    return "subgoal_centers" in poutine.trace(model).get_trace(window).nodes


def predict_steps(model: Model, window: Window, samples: int) -> Prediction:
    """f's states after each observed push of windows `[B]`, given the state before it."""
    nodes: Any = poutine.trace(model).get_trace(window).nodes
    states = window.states
    before, after = states.step(slice(0, -1)), states.step(slice(1, None))
    chosen = _components(after.features)
    return Prediction(
        nodes["next_centers"]["fn"].sample((samples,)),
        # One sample at a time: all of them with all components would be large.
        torch.stack([nodes["next_features"]["fn"].sample()[..., chosen] for _ in range(samples)]),
        after.centers,
        after.features[..., chosen],
        counted := before.mask & after.mask & window.transition_mask.unsqueeze(-1),
        counted & _far(after.centers - before.centers),
    )


def predict_subgoals(model: Model, window: Window, samples: int, *, guide: Guide | None = None) -> Prediction:
    """h's states after windows `[B]`, given the first state and a code for each sample.

    Codes come from the guide if there is one, else from the prior: then it is p(s' | s), mixed over p(c | s).
    """
    chosen, parts = _components(window.last.features), []
    for count, copies in repeated(window, samples):
        program: Any = model
        if guide is not None:
            program = poutine.replay(model, trace=poutine.trace(guide).get_trace(copies))
        nodes: Any = poutine.trace(program).get_trace(copies, generate=True).nodes
        centers, features = nodes["subgoal_centers"]["value"], nodes["subgoal_features"]["value"][..., chosen]
        parts.append((centers.unflatten(0, (count, -1)), features.unflatten(0, (count, -1))))
    centers, features = (torch.cat(fields) for fields in zip(*parts, strict=True))
    first, last = window.first, window.last
    counted = first.mask & last.mask
    moved = counted & _far(last.centers - first.centers)
    return Prediction(centers, features, last.centers, last.features[..., chosen], counted, moved)


def predict_actions(model: Model, window: Window, samples: int, *, guide: Guide) -> Tensor:
    """g's pushes of windows `[B]`, with codes from the guide: `[samples, B, T, 4]` normalised."""
    parts = []
    for count, copies in repeated(window, samples):
        replayed: Any = poutine.replay(model, trace=poutine.trace(guide).get_trace(copies))
        actions = poutine.trace(replayed).get_trace(copies, generate=True).nodes["actions"]["value"]
        parts.append(actions.unflatten(0, (count, -1)))
    return torch.cat(parts)


class Scale(NamedTuple):
    """How wide a quantity's likelihood is, against what would be right."""

    stated: float  # root of the mean variance of samples
    error: float  # root of the mean squared error of their mean
    ratio: Interval  # stated over error, with a 95 % interval over episodes; 1 is right, above it too wide


def scale_of(samples: Tensor, real: Tensor, counted: Tensor, episodes: Tensor, *, seed: int = 0) -> Scale:
    """Scale of samples `[S, B, ...]` of `real: [B, ...]`, over entries that are `counted: [B, ...]` bool.

    Args:
        episodes: of the windows `[B]`.
    """
    variance = (samples.var(0) * counted).double().flatten(1).sum(1)
    # The mean of S samples errs by itself; that much is taken off.
    squared = ((real - samples.mean(0)).square() * counted).double().flatten(1).sum(1) - variance / len(samples)
    weight = counted.expand_as(real).double().flatten(1).sum(1)

    def ratio(weights: Tensor) -> Tensor:
        return (weights @ variance / (weights @ squared).clamp(min=1e-30)).sqrt()

    if weight.sum() == 0:
        return Scale(math.nan, math.nan, Interval(math.nan, math.nan, math.nan))
    stated, error = ((total.sum() / weight.sum()).clamp(min=0).sqrt().item() for total in (variance, squared))
    return Scale(stated, error, bootstrap_interval(ratio, episodes, seed=seed))


class Transforms(NamedTuple):
    """PIT of every observed number of a `Prediction`, in [0, 1]."""

    centers: Tensor  # [..., M, 3]
    features: Tensor  # [..., M, 8]


def transform(prediction: Prediction) -> Transforms:
    """Where the truth lies among the samples."""
    return Transforms(
        probability_integral_transform(prediction.centers, prediction.real_centers),
        probability_integral_transform(prediction.features, prediction.real_features),
    )


def by_group(prediction: Prediction, transforms: Transforms) -> dict[str, dict[str, Tensor]]:
    """PIT `[N]` of each coordinate (x, y, z, feature), for all objects, those that moved, and those that lay still."""
    return {
        group: {
            **{name: transforms.centers[which][:, axis] for axis, name in enumerate(AXES)},
            "feature": transforms.features[which].flatten(),
        }
        for group, which in _groups(prediction).items()
    }


def judge(prediction: Prediction, transforms: Transforms) -> dict[str, dict[str, dict[str, Any]]]:
    """The `scores` of each group and coordinate, named as in `by_group`."""
    judged: dict[str, dict[str, dict[str, Any]]] = {}
    for group, pits in by_group(prediction, transforms).items():
        which = _groups(prediction)[group]
        centers, real = prediction.centers[:, which], prediction.real_centers[which]
        judged[group] = {name: scores(centers[..., axis], real[:, axis], pits[name]) for axis, name in enumerate(AXES)}
        features, real = prediction.features[:, which].flatten(1), prediction.real_features[which].flatten()
        judged[group]["feature"] = scores(features, real, pits["feature"])
    return judged


def _groups(prediction: Prediction) -> dict[str, Tensor]:
    counted, moved = prediction.counted, prediction.moved
    return {"all": counted, "moved": moved, "still": counted & ~moved}


def _components(features: Tensor) -> Tensor:
    return torch.randperm(features.shape[-1])[:FEATURES]


def _far(change: Tensor) -> Tensor:
    return change.norm(dim=-1) > MOVED


def probability_integral_transform(samples: Tensor, observed: Tensor) -> Tensor:
    """Where `observed: [...]` lies among `samples: [S, ...]`, in [0, 1]: uniform for a prediction that is right.

    The rank is randomised within its step, so that uniform means exactly uniform for any S.
    """
    below, equal = (samples < observed).sum(0), (samples == observed).sum(0)
    return (below + torch.rand(observed.shape) * (equal + 1)) / (len(samples) + 1)


def coverage(transform: Tensor, level: float) -> float:
    """Share of the observed values, by their PIT `[N]`, that the central interval of a level holds."""
    return ((transform - 0.5).abs() <= level / 2).double().mean().item()


def scores(samples: Tensor, observed: Tensor, transform: Tensor) -> dict[str, Any]:
    """How well `samples: [S, N]` predict `observed: [N]`, whose PIT is `transform: [N]`.

    Returns:
        count: N. rms_error: of the samples' mean, which is the scale that would be right for a Gaussian with this
        mean. scale: root of the samples' mean variance, the scale that the model states. coverage: of each level,
        by its percentage. crps: mean, in the units of `observed`. All but count are NaN for N = 0.
    """
    if len(observed) == 0:
        nothing = float("nan")
        blank = dict.fromkeys(map(percentage, LEVELS), nothing)
        return {"count": 0, "rms_error": nothing, "scale": nothing, "coverage": blank, "crps": nothing}
    error = observed - samples.mean(0)
    return {
        "count": len(observed),
        "rms_error": error.square().mean().sqrt().item(),
        "scale": samples.var(0).mean().sqrt().item(),
        "coverage": {percentage(level): coverage(transform, level) for level in LEVELS},
        "crps": crps_empirical(samples, observed).mean().item(),
    }


def percentage(level: float) -> str:
    """A level as a key of report.json."""
    return f"{100 * level:.0f}"


def energy_score(samples: Tensor, observed: Tensor, mask: Tensor) -> Tensor:
    """The CRPS of all real centres of a window at once, in metres: `[B]`; a single guess scores its distance.

    Args:
        samples: `[S, B, M, 3]`. observed: `[B, M, 3]`. mask: `[B, M]`.
    """
    real = mask.unsqueeze(-1)
    predicted = (samples * real).flatten(2).transpose(0, 1)
    return energy_score_empirical(predicted, (observed * real).flatten(1))
