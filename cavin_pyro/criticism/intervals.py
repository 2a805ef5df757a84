"""Do intervals of f and h hold what they say? Coverage of predictions on held-out windows.

Gneiting, Balabdaoui and Raftery, "Probabilistic forecasts, calibration and sharpness", 2007. Samples suit every
likelihood, also a user's own and mixtures over codes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from matplotlib.figure import Figure
from pyro import poutine
from torch import Tensor

from cavin_pyro.criticism.estimates import covered, draw_ranks, rank, ratio_interval
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.pushing import length_text
from cavin_pyro.criticism.section import Section, conclude, within, worst
from cavin_pyro.criticism.windows import replicated, sampled_values, seeded
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model
from cavin_pyro.models.state import State, Window

LEVELS = (0.5, 0.9)  # of central intervals
GOOD, BAD = (0.86, 0.95), (0.80, 0.985)  # of the coverage of 90 % intervals
FEATURES = 8  # components of a feature to evaluate, a fixed random choice
COLORS = {"centres": "#009E73", "moved": "#D55E00", "features": "#0072B2", "pushes": "#CC79A7"}
LABELS = {
    "centres": "x and y of all objects",
    "moved": "x and y of objects that moved",
    "features": "features",
    "pushes": "actions",
}
PREDICTORS = {
    "f": "f, given the state and the action",
    "h_prior": "h, codes from the prior",
    "h_guide": "h, codes from the guide",
    "g_guide": "g, codes from the guide",
}

EXPLANATION = (
    "{samples} samples of each prediction of {windows} held-out windows, in which something moved, as in training. f "
    "predicts the state after each action; h the state after the segment, with codes from the prior (what can be known "
    "before acting) or from the guide, which knows the result; g the actions. No verdict rests on the objects that "
    "moved more than {scale}: that group is chosen by the truth, so that a right model need not cover 90 % of it. The "
    "stated scale is the spread of the samples, the RMS error of their mean what is right. Scales are the weights of "
    "the loss: one four times too wide weighs its term sixteen times too little."
)


@torch.no_grad()
def assess_intervals(context: CheckContext, *, windows: int = 400, samples: int = 200) -> Section:
    """Coverage of central intervals of f, h and g, and their scales beside their errors.

    `windows`: held-out windows, at most. `samples`: samples of each prediction.
    """
    (window, episodes), space = context.held_out(windows), context.space
    with seeded(context.seed):
        predictions = predict(context, window, samples)
        ranks = {name: rank(prediction.samples, prediction.real) for name, prediction in predictions.items()}
    scores_of = {name: score(prediction, ranks[name], episodes) for name, prediction in predictions.items()}
    levels = {
        name: within(*scores_of[name]["90"][1:], good=GOOD, bad=BAD) for name in scores_of if not name.endswith("moved")
    }
    level = worst(levels.values())
    texts = {name: f"{LABELS[name.split()[1]]} by {PREDICTORS[name.split()[0]]}" for name in scores_of}
    return Section(
        EXPLANATION.format(samples=samples, windows=len(episodes), scale=length_text(space.center_scale, space)),
        conclude(
            level,
            f"What 90 % intervals cover: good if every 95 % interval over episodes lies within {GOOD[0]:.0%} to "
            f"{GOOD[1]:.0%}, bad if one lies outside of {BAD[0]:.0%} to {BAD[1]:.1%}. Decided by: "
            f"{'; '.join(texts[name] for name, one in levels.items() if one == level)}.",
            "Train with scales=predicted, or set scales.center, scales.feature and scales.action to the RMS errors.",
            episodes,
        ),
        [
            f"90 % intervals of {texts[name]}, cover {one['90'].percent()}; the stated scale is {one['stated']:.3g}, "
            f"the RMS error {one['error']:.3g}."
            for name, one in scores_of.items()
        ],
        {"windows": len(episodes), "samples": samples, "predictions": scores_of},
        "coverage of 90 % intervals of f, x and y of all objects",
        scores_of["f centres"]["90"],
        figure=_figure(predictions, ranks),
        caption="Distribution of the PIT (where the truth lies among the samples) minus the uniform one, with a "
        "pointwise 95 % band: zero if the prediction is right; rising, then falling if its intervals are too narrow.",
    )


class Prediction(NamedTuple):
    """Samples of a quantity of windows `[B]`, what was observed, and which of it counts."""

    samples: Tensor  # [S, B, ...]
    real: Tensor  # [B, ...]
    counted: Tensor  # [B, ...] bool


def predict(context: CheckContext, window: Window, samples: int) -> dict[str, Prediction]:
    """Predictions of windows `[B]` by f, h and g, as far as the model has them, by predictor and quantity."""
    model, scale = context.model, context.space.center_scale
    nodes: Any = poutine.trace(model).get_trace(window).nodes
    before, after = window.states.step(slice(0, -1)), window.states.step(slice(1, None))
    chosen = torch.randperm(after.features.shape[-1])[:FEATURES]
    sampled = nodes["next_centers"]["fn"].sample((samples,))
    # One sample at a time: all of them with all components would be large.
    features = torch.stack([nodes["next_features"]["fn"].sample()[..., chosen] for _ in range(samples)])
    predictions = _states("f", sampled, features, before, after, chosen, scale, window.transition_mask.unsqueeze(-1))
    if "subgoal_centers" in nodes:
        for name, guide in (("h_prior", None), ("h_guide", context.guide)):
            sites = sample_sites(model, window, samples, ("subgoal_centers", "subgoal_features"), guide)
            centers, features = sites["subgoal_centers"], sites["subgoal_features"][..., chosen]
            predictions |= _states(name, centers, features, window.first, window.last, chosen, scale)
    if "actions" in nodes and context.codes:
        pushes = sample_sites(model, window, samples, ("actions",), context.guide)["actions"]
        predictions["g_guide pushes"] = Prediction(
            pushes, window.actions, torch.ones_like(window.actions, dtype=torch.bool)
        )
    return predictions


def _states(
    name: str,
    centers: Tensor,
    features: Tensor,
    before: State,
    after: State,
    chosen: Tensor,
    scale: float,
    known: Tensor | bool = True,
) -> dict[str, Prediction]:
    """Predictions of centres `[S, B, ..., M, 3]` and of the `chosen` features after states; `known`: which count.

    An object that moved by more than `scale` has moved.
    """
    counted = (before.mask & after.mask & known).unsqueeze(-1)
    moved = counted & ((after.centers - before.centers).norm(dim=-1, keepdim=True) > scale)
    plane, real = centers[..., :2], after.centers[..., :2]
    return {
        f"{name} centres": Prediction(plane, real, counted.expand_as(real)),
        f"{name} moved": Prediction(plane, real, moved.expand_as(real)),
        f"{name} features": Prediction(
            features, after.features[..., chosen], counted.expand(*counted.shape[:-1], len(chosen))
        ),
    }


def sample_sites(
    model: Model, window: Window, samples: int, sites: tuple[str, ...], guide: Guide | None
) -> dict[str, Tensor]:
    """What the program generates at some sites for windows `[B]`, with codes from the guide or prior: `[S, B, ...]`."""

    def made(copies: Window) -> dict[str, Tensor]:
        values = sampled_values(model.generate, copies, guide)
        return {site: values[site] for site in sites}

    return replicated(window, samples, made)


def score(prediction: Prediction, ranks: Tensor, episodes: Tensor) -> dict[str, Any]:
    """How well a prediction whose truth has `ranks: [B, ...]` holds, for windows of `episodes: [B]`.

    Returns intervals of the coverage by level, `"50"` and `"90"`; `stated`: root of the mean variance of the samples;
    `error`: root of the mean squared error of their mean.
    """
    samples, real, counted = prediction
    count = counted.double().flatten(1).sum(1)
    coverage = {
        f"{100 * level:.0f}": ratio_interval((covered(ranks, level) * counted).flatten(1).sum(1), count, episodes)
        for level in LEVELS
    }
    variance = samples.var(0)[counted].double().mean()
    # The mean of S samples errs by itself; that much is taken off.
    squared = (real - samples.mean(0))[counted].double().square().mean() - variance / len(samples)
    return {**coverage, "stated": variance.sqrt().item(), "error": squared.clamp(min=0).sqrt().item()}


def _figure(predictions: Mapping[str, Prediction], ranks: Mapping[str, Tensor]) -> Figure:
    predictors = list(dict.fromkeys(name.split()[0] for name in predictions))
    figure = Figure(figsize=(3.3 * len(predictors), 3.2), layout="constrained")
    panels = dict(zip(predictors, figure.subplots(1, len(predictors), squeeze=False)[0], strict=True))
    for name, prediction in predictions.items():
        predictor, quantity = name.split()
        band = quantity in ("centres", "pushes")
        draw_ranks(panels[predictor], ranks[name][prediction.counted], LABELS[quantity], COLORS[quantity], band=band)
    for predictor, panel in panels.items():
        panel.set(xlim=(0, 1), xlabel="PIT", ylabel="ECDF minus uniform")
        panel.set_title(PREDICTORS[predictor], fontsize=9)
    named = {
        name: line for panel in panels.values() for line, name in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    figure.legend(named.values(), named, loc="outside lower center", ncols=len(named), fontsize=10, frameon=False)
    return figure
